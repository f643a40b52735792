"""Detectors from outside by name: a classical one, an ONNX file, or any function Python can import.

A function is named as "package.module:function"; it takes a (H, W, 3) uint8 RGB image and returns a
dict with `keypoints` (N, 2), `scores` (N,) and optionally `descriptors` (N, D). Attributes of the
function say more: `learned` (descriptors that need no ratio test), `binary` (compared by Hamming's
distance), and `version`, to be changed when its results change: of its sources only the module's
own file is watched.

An ONNX file, like XFeat's, has one input, 1x3xHxW RGB in [0, 1] of any or of a fixed size, and
outputs with the names of that dict in that frame; each may have a leading dimension of 1. An image
is resized to a fixed size, and the keypoints are scaled back.
"""

from __future__ import annotations

import hashlib
import importlib
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, WeightsError, first_line
from ..._shared.opencv import cv2
from ..._shared.options import look_up
from ...detector.backends.interface import import_onnxruntime
from ...features.keypoints import Keypoints
from .hessian import HESSIAN
from .method import COMMON_DESCRIPTOR, BaselineError, LocalFeature
from .opencv import CLASSICAL


def find_feature(word: str) -> LocalFeature:
    """Find a local feature by its name, an ONNX file, or "package.module:function".

    Raises:
        OptionError: there is none.
        WeightsError: the file cannot be used.
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
    """Make a local feature of a function; modules in the current folder are found too."""
    module, _, name = target.partition(":")
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        function = getattr(importlib.import_module(module), name)
    except Exception as error:  # the module's own code runs here
        raise OptionError(
            f"{target} cannot be imported ({first_line(error)}): name it as package.module:function"
        ) from None
    finally:
        sys.path.remove(here)
    if not callable(function):
        raise OptionError(f"{target} is no function: it must take an image and return a dict")
    source = getattr(sys.modules[module], "__file__", None)
    watched = str(Path(source).stat().st_mtime_ns) if source else "1"
    version = f"{getattr(function, 'version', '')} {watched}"
    learned, binary = (bool(getattr(function, kind, False)) for kind in ("learned", "binary"))
    return _external_feature(target, function, version, learned, binary)


def onnx_feature(path: str | Path) -> LocalFeature:
    """Make a local feature of an ONNX file.

    Raises:
        WeightsError: the file cannot be opened, or has other inputs or outputs.
    """
    file = Path(path)
    try:
        data = file.read_bytes()
        session = import_onnxruntime().InferenceSession(data, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common base
        raise WeightsError(f"{file} is no ONNX file that runs ({first_line(error)})") from None
    outputs = [output.name for output in session.get_outputs()]
    shapes = [entry.shape for entry in session.get_inputs()]
    if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][1] != 3:
        raise WeightsError(f"{file} must have one input 1x3xHxW, RGB, not {shapes}")
    if not {"keypoints", "scores"} <= set(outputs):
        raise WeightsError(f"{file} must have the outputs keypoints and scores, not {outputs}")
    version = hashlib.sha256(data).hexdigest()[:16]
    detect = partial(_run_onnx, session, outputs)
    return _external_feature(file.stem, detect, version, learned="descriptors" in outputs)


def _run_onnx(session: Any, outputs: list[str], rgb: np.ndarray) -> dict[str, np.ndarray]:
    height, width = rgb.shape[:2]
    entry = session.get_inputs()[0]
    wanted = [
        fixed if isinstance(fixed, int) else own
        for fixed, own in zip(entry.shape[2:], (height, width), strict=True)
    ]
    # Area averaging where pixels fall together; where the image grows, that would repeat pixels.
    smaller = wanted[0] <= height and wanted[1] <= width
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    resized = cv2.resize(rgb, (wanted[1], wanted[0]), interpolation=method)
    planes = np.ascontiguousarray(resized.transpose(2, 0, 1)[None], np.float32) / 255
    found = dict(zip(outputs, session.run(None, {entry.name: planes}), strict=True))
    parts = {
        name: value[0] if value.ndim == rank + 1 else value
        for name, rank in (("keypoints", 2), ("scores", 1), ("descriptors", 2))
        if (value := found.get(name)) is not None
    }
    # The borders of both frames are the same lines, half a pixel before the first centre.
    scale = np.array([width / wanted[1], height / wanted[0]])
    return {**parts, "keypoints": (parts["keypoints"] + 0.5) * scale - 0.5}


def _external_feature(
    name: str,
    detect: Callable[[np.ndarray], Any],
    version: str,
    learned: bool,
    binary: bool = False,
) -> LocalFeature:
    """Make a local feature of a function; whatever it raises becomes a `BaselineError`."""

    def run(rgb: np.ndarray) -> Keypoints:
        size = (rgb.shape[1], rgb.shape[0])
        try:
            found = detect(rgb)
            return Keypoints(
                found["keypoints"], found["scores"], size, descriptors=found.get("descriptors")
            )
        except Exception as error:  # anyone's code
            raise BaselineError(
                f"{name} made no keypoints and scores: {type(error).__name__}: {first_line(error)}"
            ) from error

    def describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        if features.descriptors is None:
            return COMMON_DESCRIPTOR.describe(rgb, features)
        return features.descriptors

    return LocalFeature(name, name, run, describe, binary, learned, version=version)
