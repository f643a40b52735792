"""Running the network: ONNX Runtime, OpenVINO or torch."""

from .registry import BACKENDS, Network, RuntimeOptions, open_network

__all__ = ["BACKENDS", "Network", "RuntimeOptions", "open_network"]
