"""The detectors: `DeepDetect` finds dense keypoints, `PointDetector` the best few."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
