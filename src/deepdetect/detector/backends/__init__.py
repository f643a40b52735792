"""Backends that run networks: ONNX Runtime and OpenVINO."""

from .interface import Network, RuntimeOptions
from .registry import BACKENDS, backend_name, open_graph, open_network

__all__ = ["BACKENDS", "Network", "RuntimeOptions", "backend_name", "open_graph", "open_network"]
