"""Evaluate detectors by metrics, compare them with baselines, and write reports of benchmarks."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
