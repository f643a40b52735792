"""The descriptors: one line each.

To add a descriptor, write its module beside this one, with a function
`(gray, xy, size, angle) -> (N, D) uint8 or float32`, and add its line.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .._shared.errors import look_up
from .sift import opencv_sift_descriptors, root_sift_descriptors, sift_descriptors

Descriptor = Callable[[np.ndarray, np.ndarray, float, float], np.ndarray]

DESCRIPTORS: dict[str, Descriptor] = {
    "sift": sift_descriptors,
    "rootsift": root_sift_descriptors,
    "sift-opencv": opencv_sift_descriptors,
}


def get_descriptor(name: str) -> Descriptor:
    """Look a descriptor up.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("descriptor", name, DESCRIPTORS)
