"""Export of the network as ONNX files for other programs: image size, metadata, keypoints."""
