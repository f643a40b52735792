"""The learned descriptor: a network computes features of the image, sampled at the keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..._shared.errors import OptionError, WeightsError
from ..._shared.opencv import cv2
from ..._shared.records import file_digest
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
from ..backends import RuntimeOptions, open_graph
from ..backends.interface import Session, run_graph
from ..pretrained import RANKER, resolve_weights

DESCRIPTOR_GRAPHS = {
    LEARNED: RANKER.with_name("descriptor.onnx"),
    LEARNED_FREE: RANKER.with_name("descriptor_free.onnx"),
    CROSS_MODAL: RANKER.with_name("descriptor.onnx"),
}
"""ONNX files by descriptor type. Their inputs are `luma` (B, 1, H, W) in [0, 1], `xy` (B, N, 2) in
pixels and `sizes` (B, N), diameters in pixels. Their output is `descriptors` (B, N, 64), unit
vectors. All are float32."""

DIGEST_LENGTH = 16
"""The descriptor type of a user's own ONNX file ends with this many characters of its SHA-256."""

STRIDE = 128
"""The network halves an image seven times, so the image's sides must be multiples of 128."""


def describe_learned(
    gray: np.ndarray, keypoints: Keypoints, descriptor: str | Path = LEARNED
) -> Keypoints:
    """Return keypoints with learned descriptors at their own sizes and angles.

    See `describe_batch`.
    """
    return describe_batch([gray], [keypoints], descriptor)[0]


def describe_batch(
    grays: Sequence[np.ndarray],
    keypoints: Sequence[Keypoints],
    descriptor: str | Path = LEARNED,
    runtime: RuntimeOptions = RuntimeOptions(),
) -> list[Keypoints]:
    """Return the keypoints of images of one size with learned descriptors, computed in one run.

    `grays` are the (H, W) uint8 lumas of the images, possibly scaled down. Angles that are missing
    or -1 are replaced by the dominant gradient orientations. For "cross-modal", the luma is
    replaced by its `edge_strength`, and all angles by the dominant orientations of that map.
    `descriptor` is a name in `DESCRIPTOR_GRAPHS`, or an ONNX file with the same inputs and outputs.
    Keypoints without sizes raise an OptionError.
    """
    kind = descriptor_type(descriptor)
    height, width = grays[0].shape
    below, right, most = -height % STRIDE, -width % STRIDE, max(map(len, keypoints))
    luma = np.empty((len(grays), 1, height + below, width + right), np.float32)
    xy = np.zeros((len(grays), most, 2), np.float32)
    sizes = np.ones((len(grays), most), np.float32)
    angles: list[np.ndarray] = []
    for k, (gray, points) in enumerate(zip(grays, keypoints, strict=True)):
        if len(points) and (points.sizes is None or not (points.sizes > 0).all()):
            raise OptionError(
                "learned descriptors need sizes above 0: use a PointDetector's keypoints, or "
                "RootSIFT"
            )
        given, own = points.angles, slice(len(points))
        if kind == CROSS_MODAL:
            gray, given = edge_strength(gray), None
        factor = np.divide((width, height), points.image_size).astype(np.float32)
        xy[k, own] = (points.xy + 0.5) * factor - 0.5
        sizes[k, own] = 0 if points.sizes is None else points.sizes * factor.mean()
        angles.append(set_angles(gray, xy[k, own], sizes[k, own], given))
        luma[k, 0] = cv2.copyMakeBorder(gray, 0, below, 0, right, cv2.BORDER_REFLECT_101)
    upright = np.empty((len(grays), 0, LENGTH), np.float32)
    if most:
        luma /= 255
        session = _open(DESCRIPTOR_GRAPHS.get(str(descriptor), Path(descriptor)), runtime)
        inputs = {"luma": luma, "xy": xy, "sizes": sizes}
        (upright,) = run_graph(session, ["descriptors"], inputs, f"{width}x{height} pixels")
    return [
        replace(
            points,
            angles=turns,
            descriptors=turn_descriptors(codes[: len(points)], -turns),
            descriptor_type=kind,
        )
        for points, turns, codes in zip(keypoints, angles, upright, strict=True)
    ]


def descriptor_type(descriptor: str | Path) -> str:
    """Return the `Keypoints.descriptor_type` of a bundled descriptor, by name, or of an ONNX file.

    The type of a file is "learned-" and the start of its SHA-256.
    """
    if str(descriptor) in (*DESCRIPTOR_GRAPHS, ROOT_SIFT):
        return str(descriptor)
    path = resolve_weights(descriptor)
    _open(path, RuntimeOptions())  # raises an error if the file is no descriptor
    return f"{LEARNED}-{file_digest(path)[:DIGEST_LENGTH]}"


def _open(path: Path, runtime: RuntimeOptions) -> Session:
    """Load a file; one that does not describe keypoints raises a WeightsError."""
    session = open_graph(path, runtime)
    names = {*session.inputs}, {*session.outputs}
    if names != ({"luma", "xy", "sizes"}, {"descriptors"}):
        raise WeightsError(
            f"{path} does not describe keypoints: use the descriptor.onnx that `deepdetect "
            "train-descriptor` writes"
        )
    return session
