"""The network as ONNX files for other programs: of one size, with points, with metadata."""
