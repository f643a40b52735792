"""ONNX files of the network for other programs: sizes, metadata, keypoints, writing."""
