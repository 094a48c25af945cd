"""Training of a small policy from demonstrations; needs only PyTorch, NumPy and onnx."""
