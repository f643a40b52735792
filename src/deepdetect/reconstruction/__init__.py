"""Reconstruct 3D points from two images: calibration, pose, triangulation, and checks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
