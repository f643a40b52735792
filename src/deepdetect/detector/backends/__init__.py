"""Running the network: ONNX Runtime or OpenVINO."""

from .interface import Network, RuntimeOptions
from .registry import BACKENDS, open_network

__all__ = ["BACKENDS", "Network", "RuntimeOptions", "open_network"]
