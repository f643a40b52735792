"""Two images in, points in space out: calibration, pose, triangulation, what is wrong."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
