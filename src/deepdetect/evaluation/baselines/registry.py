"""The classical methods, one line each, and how a word on the command line becomes a method.

To add a detector of OpenCV's or one's own, write its module beside this one and add its line.
"""

from __future__ import annotations

from pathlib import Path

from ..._shared.errors import OptionError
from ..._shared.registry import look_up
from .agast import AGAST_DEFAULT, AGAST_LOW
from .brisk import BRISK_DEFAULT, BRISK_LOW
from .fast import FAST_DEFAULT, FAST_LOW
from .harris import HARRIS_DEFAULT, HARRIS_LOW, HARRIS_MAXIMA
from .importable import importable_method
from .method import Method
from .onnx_file import onnx_method
from .orb import ORB_DEFAULT, ORB_LOW, ORB_MANY
from .shi_tomasi import SHI_TOMASI_DEFAULT, SHI_TOMASI_EIGENVALUE, SHI_TOMASI_LOW
from .sift import SIFT_DEFAULT, SIFT_LOW

CLASSICAL: dict[str, Method] = {
    method.name: method
    for method in (
        SIFT_DEFAULT,
        SIFT_LOW,
        ORB_DEFAULT,
        ORB_LOW,
        BRISK_DEFAULT,
        BRISK_LOW,
        FAST_DEFAULT,
        FAST_LOW,
        AGAST_DEFAULT,
        AGAST_LOW,
        HARRIS_DEFAULT,
        HARRIS_LOW,
        SHI_TOMASI_DEFAULT,
        SHI_TOMASI_LOW,
    )
}


STANDARD: dict[str, Method] = {
    "sift": SIFT_DEFAULT,
    "orb": ORB_MANY,
    "brisk": BRISK_DEFAULT,
    "fast": FAST_DEFAULT,
    "agast": AGAST_DEFAULT,
    "harris": HARRIS_MAXIMA,
    "shi-tomasi": SHI_TOMASI_EIGENVALUE,
}
"""By the names of the default settings, what takes their place where methods are compared by their
best so many keypoints: settings that give enough of them, in an order of worth."""


def find_method(word: str) -> Method:
    """Find a method by its name, an ONNX file, or "package.module:function".

    Raises:
        OptionError: there is none such.
        WeightsError: the file cannot be used.

    Example:
        >>> find_method("fast-low").title
        'FAST, low settings'
    """
    if Path(word).suffix == ".onnx":
        return onnx_method(word)
    if ":" in word:
        return importable_method(word)
    try:
        return look_up("method", word, CLASSICAL)
    except OptionError as error:
        raise OptionError(f"{error}; or give an ONNX file, or package.module:function") from None
