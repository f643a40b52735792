from tests.detector.conftest import fast_files, fast_network, onnx_file  # noqa: F401
