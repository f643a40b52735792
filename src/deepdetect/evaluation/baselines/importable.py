"""Any detector that Python can import joins the benchmark as one more row.

It is named as "package.module:function"; the function takes a (H, W, 3) uint8 RGB image and
returns a dict with `keypoints` (N, 2), `scores` (N,) and maybe `descriptors` (N, D). Attributes of
the function tell more: `learned` (descriptors that need no ratio test), `binary` (compared by
Hamming's distance), and `version`, to be changed when its results change: of its sources only the
module's own file is watched.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from ..._shared.errors import OptionError
from ...features.keypoints import Keypoints
from .heatmaps import COMMON_DESCRIPTOR
from .method import Method


def importable_method(target: str) -> Method:
    """Make a method of a function.

    Args:
        target: "package.module:function"; modules in the current folder are found too.

    Raises:
        OptionError: it cannot be imported, or is no function.
    """
    function = _find(target)

    def detect(rgb: np.ndarray) -> Keypoints:
        found = function(rgb)
        if not isinstance(found, Mapping) or not {"keypoints", "scores"} <= set(found):
            raise OptionError(f"{target} must return a dict with 'keypoints' and 'scores'")
        size = (rgb.shape[1], rgb.shape[0])
        return Keypoints(
            found["keypoints"], found["scores"], size, descriptors=found.get("descriptors")
        )

    def describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        if features.descriptors is None:
            return COMMON_DESCRIPTOR.describe(rgb, features)
        return features.descriptors

    source = getattr(sys.modules.get(target.partition(":")[0]), "__file__", None)
    version = str(Path(source).stat().st_mtime_ns) if source else "1"
    return Method(
        target,
        target,
        detect,
        describe,
        binary=bool(getattr(function, "binary", False)),
        learned=bool(getattr(function, "learned", False)),
        version=f"{getattr(function, 'version', '')} {version}",
    )


def _find(target: str) -> Callable[[np.ndarray], Mapping[str, np.ndarray]]:
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
