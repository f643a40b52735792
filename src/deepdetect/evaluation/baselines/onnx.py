"""Other networks as ONNX files that return keypoints, like XFeat's.

The file has one input, 1x3xHxW RGB in [0, 1] of any or of a fixed size, and outputs named
`keypoints` (N, 2) in that frame, `scores` (N,), and optionally `descriptors` (N, D); each may have
a leading dimension of 1. An image is resized to a fixed size, and the keypoints are scaled back.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import WeightsError
from ..._shared.opencv import cv2
from ...detector.backends.without_telemetry import import_onnxruntime
from .method import LocalFeature, external_feature


def onnx_feature(path: str | Path, name: str | None = None) -> LocalFeature:
    """Make a local feature of an ONNX file.

    Args:
        path: the file.
        name: as of `LocalFeature`; default the file's name.

    Raises:
        WeightsError: the file cannot be opened, or has other inputs or outputs.
    """
    file = Path(path)
    try:
        data = file.read_bytes()
    except OSError as error:
        raise WeightsError(f"{file} cannot be read ({error.strerror}): check the path") from None
    session = _open(data, file)
    outputs = [output.name for output in session.get_outputs()]
    shapes = [entry.shape for entry in session.get_inputs()]
    if len(shapes) != 1 or len(shapes[0]) != 4 or shapes[0][1] != 3:
        raise WeightsError(f"{file} must have one input 1x3xHxW, RGB, not {shapes}")
    if not {"keypoints", "scores"} <= set(outputs):
        raise WeightsError(f"{file} must have the outputs keypoints and scores, not {outputs}")

    def detect(rgb: np.ndarray) -> dict[str, np.ndarray]:
        return _detect(session, outputs, rgb)

    return external_feature(
        name or file.stem,
        detect,
        learned="descriptors" in outputs,
        version=hashlib.sha256(data).hexdigest()[:16],
    )


def _open(data: bytes, file: Path) -> Any:
    onnxruntime = import_onnxruntime()
    try:
        return onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common base
        reason = str(error).splitlines()[0]
        raise WeightsError(f"{file} is no ONNX file that can be run ({reason})") from None


def _detect(session: Any, outputs: list[str], rgb: np.ndarray) -> dict[str, np.ndarray]:
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
