"""Running the network: ONNX Runtime, OpenVINO or torch."""

from .options import BACKENDS, Network, RuntimeOptions
from .registry import open_network

__all__ = ["BACKENDS", "Network", "RuntimeOptions", "open_network"]
