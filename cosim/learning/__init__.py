"""A small policy of one's own, learned from demonstrations: needs PyTorch, NumPy and onnx, and
nothing else."""
