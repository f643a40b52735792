"""The network as ONNX files for other programs: with a fixed size, with points, with metadata."""
