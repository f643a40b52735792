"""The detectors: dense keypoints from the network's heat map, and ranked points."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
