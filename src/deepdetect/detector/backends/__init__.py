"""Running the network: ONNX Runtime, OpenVINO or torch."""

from .interface import BACKENDS, Network, RuntimeOptions
from .registry import open_network

__all__ = ["BACKENDS", "Network", "RuntimeOptions", "open_network"]
