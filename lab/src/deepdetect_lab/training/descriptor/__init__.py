"""Training the learned descriptor: photographs -> pairs of views -> network -> ONNX file."""
