"""Descriptors: what the surroundings of a keypoint look like, as a vector."""

from ..descriptors_registry import DESCRIPTORS, Descriptor, get_descriptor

__all__ = ["DESCRIPTORS", "Descriptor", "get_descriptor"]
