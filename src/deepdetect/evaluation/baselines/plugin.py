"""Detectors from outside by name: a classical one, an ONNX file, or any function Python can import.

A function is named as "package.module:function"; it takes a (H, W, 3) uint8 RGB image and returns a
dict with `keypoints` (N, 2), `scores` (N,) and optionally `descriptors` (N, D). Attributes of the
function say more: `learned` (descriptors that need no ratio test), `binary` (compared by Hamming's
distance), and `version`, to be changed when its results change: of its sources only the module's
own file is watched.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.registry import look_up
from .hessian import HESSIAN
from .method import LocalFeature, external_feature
from .onnx import onnx_feature
from .opencv import CLASSICAL


def find_feature(word: str) -> LocalFeature:
    """Find a local feature by its name, an ONNX file, or "package.module:function".

    Raises:
        OptionError: there is none.
        WeightsError: the file cannot be used.

    Example:
        >>> find_feature("fast-low").title
        'FAST, low settings'
    """
    if Path(word).suffix == ".onnx":
        return onnx_feature(word)
    if ":" in word:
        return plugin_feature(word)
    try:
        return look_up("method", word, {**CLASSICAL, **HESSIAN})
    except OptionError as error:
        raise OptionError(f"{error}; or give an ONNX file, or package.module:function") from None


def plugin_feature(target: str) -> LocalFeature:
    """Make a local feature of a function.

    Args:
        target: "package.module:function"; modules in the current folder are found too.

    Raises:
        OptionError: it cannot be imported, or is no function.
    """
    function = _import(target)
    source = getattr(sys.modules.get(target.partition(":")[0]), "__file__", None)
    version = str(Path(source).stat().st_mtime_ns) if source else "1"
    return external_feature(
        target,
        function,
        binary=bool(getattr(function, "binary", False)),
        learned=bool(getattr(function, "learned", False)),
        version=f"{getattr(function, 'version', '')} {version}",
    )


def _import(target: str) -> Callable[[np.ndarray], Any]:
    module_name, _, name = target.partition(":")
    here = str(Path.cwd())
    added = here not in sys.path
    if added:
        sys.path.insert(0, here)
    try:
        function = getattr(importlib.import_module(module_name), name)
    except Exception as error:  # the module's own code runs here
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise OptionError(
            f"{target} cannot be imported ({reason}): name it as package.module:function"
        ) from None
    finally:
        if added:
            sys.path.remove(here)
    if not callable(function):
        raise OptionError(f"{target} is no function: it must take an image and return a dict")
    return function
