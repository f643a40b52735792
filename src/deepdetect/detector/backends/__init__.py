"""Backends that run the network: ONNX Runtime and OpenVINO."""

from .interface import Network, RuntimeOptions
from .registry import BACKENDS, open_network

__all__ = ["BACKENDS", "Network", "RuntimeOptions", "open_network"]
