"""For vismatch: `vismatch/im_models/deepdetect.py`. The matcher itself is part of deepdetect."""

from deepdetect.integrations.vismatch import DeepDetectMatcher

__all__ = ["DeepDetectMatcher"]
