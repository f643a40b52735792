"""Find detectors by name: a classical detector, an ONNX file, or an importable function.

A function is named as "package.module:function". It takes an (H, W, 3) uint8 RGB image and returns
a dict with `keypoints` (N, 2), `scores` (N,) and optionally `descriptors` (N, D). It may have the
attributes `learned` (its descriptors need no ratio test), `binary` (its descriptors are compared by
Hamming distance) and `version`. Change `version` whenever the results change, because the cache of
results only notices changes in the module's own file.

An ONNX file has one input with values in [0, 1]: 1x3xHxW, an RGB image, or 1x1xHxW, the mean of the
three channels. H and W may be fixed or free. There are two kinds of outputs:

- lists, as in XFeat: `keypoints` in pixels of the input, `scores`, and optionally `descriptors`,
  with the shapes given above. They may have an additional leading dimension of 1.
- maps, as in EdgePoint2: `scores`, 1x1xHxW logits whose local maxima become the keypoints, and
  `descriptors`, 1xDxhxw, from which the descriptors of the keypoints are interpolated.

If H and W are fixed, images are resized to them. If they are free and the outputs are maps, image
sides are resized to multiples of 32. Keypoints are scaled back to the original image.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from deepdetect._shared.errors import OptionError, WeightsError, first_line
from deepdetect._shared.opencv import cv2
from deepdetect._shared.options import look_up
from deepdetect._shared.records import file_digest
from deepdetect.detector.backends.interface import RuntimeOptions, Session
from deepdetect.detector.backends.registry import open_graph
from deepdetect.features.keypoints import Keypoints

from .hessian import HESSIAN
from .method import COMMON_DESCRIPTOR, BaselineError, LocalFeature
from .opencv import CLASSICAL

MAP_SIDE, MAP_BORDER_PX, MAP_LEAST_LOGIT, MAP_WINDOW = 32, 4, -5, np.ones((5, 5), np.uint8)
"""Settings for ONNX files that output maps; the values are those of EdgePoint2. Image sides are
resized to multiples of `MAP_SIDE` pixels. Keypoints are at least `MAP_BORDER_PX` from the border,
have a logit over `MAP_LEAST_LOGIT`, and are the maximum of the window `MAP_WINDOW` around them."""


def find_feature(word: str) -> LocalFeature:
    """Return the local feature for a baseline's name, an ONNX file, or "package.module:function".

    Raises:
        OptionError: no baseline has this name, or the function cannot be imported.
        WeightsError: the ONNX file cannot be used.
    """
    if Path(word).suffix == ".onnx":
        return onnx_feature(word)
    if ":" in word:
        return plugin_feature(word)
    try:
        return look_up("method", word, {**CLASSICAL, **HESSIAN})
    except OptionError as error:
        raise OptionError(f"{error}; or give an ONNX file or package.module:function") from None


def imported(target: str) -> Any:
    """Return the function "package.module:function". Its module may be in the current folder."""
    module, _, name = target.partition(":")
    here = str(Path.cwd())
    sys.path.insert(0, here)
    try:
        function = getattr(importlib.import_module(module), name)
    except Exception as error:  # the module's code may raise anything
        raise OptionError(
            f"{target} cannot be imported ({first_line(error)}): give package.module:function"
        ) from None
    finally:
        sys.path.remove(here)
    if not callable(function):
        raise OptionError(f"{target} is not a function: give one as package.module:function")
    return function


def plugin_feature(target: str) -> LocalFeature:
    """Make a local feature from an importable function, which takes an image."""
    function, module = imported(target), target.partition(":")[0]
    source = getattr(sys.modules[module], "__file__", None)
    watched = str(Path(source).stat().st_mtime_ns) if source else "1"
    version = f"{getattr(function, 'version', '')} {watched}"
    learned, binary = (bool(getattr(function, kind, False)) for kind in ("learned", "binary"))
    return _external_feature(target, function, version, learned, binary)


def onnx_feature(
    path: str | Path, backend: str = "onnxruntime", threads: int | None = None
) -> LocalFeature:
    """Make a local feature from an ONNX file. The backend is "onnxruntime" or "openvino".

    Raises:
        WeightsError: the file cannot be opened, or lacks an input or output that the text at the
            top of this module describes.
    """
    file = Path(path)
    try:
        version = file_digest(file)[:16]
        graph = onnx.load(file, load_external_data=False).graph
        session = open_graph(file, RuntimeOptions(backend, threads=threads))
    except Exception as error:  # the exceptions of runtimes have no common base
        raise WeightsError(f"{file} is not a usable ONNX file ({first_line(error)})") from None
    shapes = [
        [side.dim_value or None for side in one.type.tensor_type.shape.dim]
        for one in graph.input
        if one.name in session.inputs
    ]
    if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][1] not in (1, 3):
        raise WeightsError(f"{file} must have one input, 1x3xHxW or 1x1xHxW, not {shapes}")
    outputs = session.outputs
    if "scores" not in outputs or not {"keypoints", "descriptors"} & {*outputs}:
        raise WeightsError(
            f"{file} must have the outputs 'scores' and 'keypoints', or the maps 'scores' and "
            f"'descriptors', not {outputs}"
        )
    learned = "descriptors" in outputs
    return _external_feature(file.stem, partial(_run_onnx, session, shapes[0]), version, learned)


def _run_onnx(
    session: Session, shape: Sequence[int | None], rgb: np.ndarray
) -> dict[str, np.ndarray]:
    """Run a network whose input has this shape, in which free sides are None."""
    height, width = rgb.shape[:2]
    maps = "keypoints" not in session.outputs
    wanted = [
        side or (max(1, round(own / MAP_SIDE)) * MAP_SIDE if maps else own)
        for side, own in zip(shape[2:], (height, width), strict=True)
    ]
    # Area averaging is only good for downscaling; when upscaling, it would repeat pixels.
    smaller = wanted[0] <= height and wanted[1] <= width
    method = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    resized = cv2.resize(rgb, (wanted[1], wanted[0]), interpolation=method)
    planes = np.ascontiguousarray(resized.transpose(2, 0, 1)[None], np.float32) / 255
    if shape[1] == 1:
        planes = planes.mean(axis=1, keepdims=True)
    values = session.run(session.outputs, {session.inputs[0]: planes})
    found = dict(zip(session.outputs, values, strict=True))
    if maps:
        parts = _maxima(found["scores"][0, 0], found["descriptors"][0])
    else:
        parts = {
            name: value[0] if value.ndim == rank + 1 else value
            for name, rank in (("keypoints", 2), ("scores", 1), ("descriptors", 2))
            if (value := found.get(name)) is not None
        }
    # Resizing keeps the image borders, which are half a pixel beyond the centres of outer pixels.
    scale = np.array([width / wanted[1], height / wanted[0]])
    return {**parts, "keypoints": (parts["keypoints"] + 0.5) * scale - 0.5}


def _maxima(logits: np.ndarray, descriptors: np.ndarray) -> dict[str, np.ndarray]:
    """Return local maxima of (H, W) logits as keypoints, with descriptors from a (D, h, w) map."""
    peaks = (logits == cv2.dilate(logits, MAP_WINDOW)) & (logits > MAP_LEAST_LOGIT)
    inner = slice(MAP_BORDER_PX, -MAP_BORDER_PX)
    xy = np.argwhere(peaks[inner, inner])[:, ::-1] + MAP_BORDER_PX
    scale = np.divide(descriptors.shape[:0:-1], logits.shape[::-1])
    last = np.array(descriptors.shape[:0:-1]) - 1
    place = np.clip((xy + 0.5) * scale - 0.5, 0, last)
    column, row = np.floor(np.minimum(place, last - 1)).astype(int).T
    right, below = place.T - (column, row)
    values = sum(
        descriptors[:, row + down, column + aside]
        * (np.abs(1 - down - below) * np.abs(1 - aside - right)).astype(np.float32)
        for down, aside in np.ndindex(2, 2)
    )
    scores = logits[xy[:, 1], xy[:, 0]]
    return {
        "keypoints": xy,
        "scores": scores,
        "descriptors": (values / np.linalg.norm(values, axis=0)).T,
    }


def _external_feature(
    name: str,
    detect: Callable[[np.ndarray], Any],
    version: str,
    learned: bool,
    binary: bool = False,
) -> LocalFeature:
    def run(rgb: np.ndarray) -> Keypoints:
        size = (rgb.shape[1], rgb.shape[0])
        try:
            found = detect(rgb)
            return Keypoints(
                found["keypoints"], found["scores"], size, descriptors=found.get("descriptors")
            )
        except Exception as error:  # external code may raise anything
            raise BaselineError(
                f"{name} did not return usable keypoints and scores: "
                f"{type(error).__name__}: {first_line(error)}"
            ) from error

    def describe(rgb: np.ndarray, features: Keypoints) -> np.ndarray:
        if features.descriptors is None:
            return COMMON_DESCRIPTOR.describe(rgb, features)
        return features.descriptors

    return LocalFeature(name, name, run, describe, binary, learned, version=version)
