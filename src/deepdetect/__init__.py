"""DeepDetect: dense keypoints from a tiny network, their matches, and 3D reconstruction.

    >>> from deepdetect import DeepDetect, match_images
    >>> detector = DeepDetect()

The packages in the order of the data: `io` (images) -> `detector` (heat map) -> `features`
(keypoints, descriptors, matchers) -> `geometry` -> `matching` -> `reconstruction`.
"""

import lazy_loader

__version__ = "1.0.0rc1"

# Names are imported when they are first used, so that the command line starts fast; which, and
# from where, is in `__init__.pyi`, which type checkers and editors read, too.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
