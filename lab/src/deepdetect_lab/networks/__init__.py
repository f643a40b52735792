"""Networks in torch, their trained weights, and their export to ONNX files."""
