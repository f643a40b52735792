"""Guided matching: geometries are proposed, judged by the images, and predict dense matches."""

from .explanation import Explanation
from .image_pair import ImagePair, Pair
from .proposals import Sources, Tentative

__all__ = ["Explanation", "ImagePair", "Pair", "Sources", "Tentative"]
