"""DeepDetect: dense keypoints from a tiny network, their matches, and 3D reconstruction.

    >>> from deepdetect import DeepDetect, match_images
    >>> detector = DeepDetect()

Data flows through the packages `io` (images) -> `detector` (heat map) -> `features` (keypoints,
descriptors, matchers) -> `geometry` -> `matching` -> `reconstruction`.
"""

import lazy_loader

__version__ = "1.0.0rc1"

# Each name is imported at its first use, so that the command line starts fast. The names are listed
# in `__init__.pyi`, which type checkers and editors also read.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
