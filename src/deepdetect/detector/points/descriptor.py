"""The learned descriptor: a network computes features of the image, sampled at the keypoints."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..._shared.errors import OptionError, WeightsError, first_line
from ..._shared.machine import thread_limit
from ..._shared.opencv import cv2
from ..._shared.records import file_digest
from ..._shared.runtimes import start_session
from ...features.keypoints import Keypoints
from ...features.learned import (
    CROSS_MODAL,
    LEARNED,
    LEARNED_FREE,
    LENGTH,
    turn_descriptors,
)
from ...features.scale_space import set_angles
from ...features.sift import ROOT_SIFT
from ...geometry.images import edge_strength
from ..pretrained import RANKER, resolve_weights

DESCRIPTOR_GRAPHS = {
    LEARNED: RANKER.with_name("descriptor.onnx"),
    LEARNED_FREE: RANKER.with_name("descriptor_free.onnx"),
    CROSS_MODAL: RANKER.with_name("descriptor.onnx"),
}
"""ONNX files by descriptor type. Their inputs are `luma` (1, 1, H, W) in [0, 1], `xy` (1, N, 2) in
pixels and `sizes` (1, N), diameters in pixels. Their output is `descriptors` (1, N, 64), unit
vectors. All are float32."""

DIGEST_LENGTH = 16
"""The descriptor type of a user's own ONNX file ends with this many characters of its SHA-256."""

STRIDE = 128
"""The network halves an image seven times, so the image's sides must be multiples of 128."""


def describe_learned(
    gray: np.ndarray, keypoints: Keypoints, descriptor: str | Path = LEARNED
) -> Keypoints:
    """Return keypoints with learned descriptors at their own sizes and angles.

    `gray` is the (H, W) uint8 luma of the image, possibly scaled down. Angles that are missing or
    -1 are replaced by the dominant gradient orientations. For "cross-modal", the luma is replaced
    by its `edge_strength`, and all angles by the dominant orientations of that map. `descriptor` is
    a name in `DESCRIPTOR_GRAPHS`, or an ONNX file with the same inputs and outputs. Keypoints
    without sizes raise an OptionError.
    """
    kind = descriptor_type(descriptor)
    if not len(keypoints):
        none = np.empty((0, LENGTH), np.float32)
        return replace(keypoints, descriptors=none, descriptor_type=kind)
    if keypoints.sizes is None or not (keypoints.sizes > 0).all():
        raise OptionError(
            "learned descriptors need sizes above 0: use a PointDetector's keypoints, or RootSIFT"
        )
    given = keypoints.angles
    if kind == CROSS_MODAL:
        gray, given = edge_strength(gray), None
    height, width = gray.shape
    factor = np.divide((width, height), keypoints.image_size).astype(np.float32)
    xy, sizes = (keypoints.xy + 0.5) * factor - 0.5, keypoints.sizes * factor.mean()
    angles = set_angles(gray, xy, sizes, given)
    below, right = -height % STRIDE, -width % STRIDE
    padded = cv2.copyMakeBorder(gray, 0, below, 0, right, cv2.BORDER_REFLECT_101)
    luma = padded[None, None].astype(np.float32) / 255
    inputs = {"luma": luma, "xy": xy[None], "sizes": sizes[None]}
    path = DESCRIPTOR_GRAPHS.get(str(descriptor), Path(descriptor))
    session = _session(path, kind[-DIGEST_LENGTH:], thread_limit())
    upright = session.run(["descriptors"], inputs)[0][0]
    descriptors = turn_descriptors(upright, -angles)
    return replace(keypoints, angles=angles, descriptors=descriptors, descriptor_type=kind)


def descriptor_type(descriptor: str | Path) -> str:
    """Return the `Keypoints.descriptor_type` of a bundled descriptor, by name, or of an ONNX file.

    The type of a file is "learned-" and the start of its SHA-256.
    """
    if str(descriptor) in (*DESCRIPTOR_GRAPHS, ROOT_SIFT):
        return str(descriptor)
    path = resolve_weights(descriptor)
    digest = file_digest(path)[:DIGEST_LENGTH]
    _session(path, digest, thread_limit())  # raises an error if the file is no descriptor
    return f"{LEARNED}-{digest}"


@functools.cache
def _session(path: Path, content: str, threads: int | None) -> Any:
    """Load a file, unless it is cached with the same `content`, the start of its SHA-256."""
    try:
        session = start_session(str(path), threads)
        names = [each.name for each in (*session.get_inputs(), *session.get_outputs())]
        if names != ["luma", "xy", "sizes", "descriptors"]:
            raise ValueError("its inputs and outputs are not those of a descriptor")
    except Exception as error:  # the exceptions of ONNX Runtime share no base class
        raise WeightsError(
            f"{path} does not describe keypoints ({first_line(error)}): "
            "use the descriptor.onnx that `deepdetect train-descriptor` writes"
        ) from None
    return session
