"""Matching of two images, registration, panoramas, and disparity maps of rectified pairs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
