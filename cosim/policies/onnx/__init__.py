"""Policies as ONNX graphs: a folder with `model.onnx`, `manifest.json` and `example.npz`."""
