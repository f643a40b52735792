"""Detection of points by an ONNX graph, in a runtime that may use a graphics card."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...features.keypoints import Keypoints
from ...io.image import at_pixels
from ..backends import RuntimeOptions, open_graph
from ..backends.interface import Session, run_graph
from ..pretrained import GRAY, MAX_KEYPOINTS, POINTS, POINTS_GRAPH
from .detection import ranking_logits


def open_points(runtime: RuntimeOptions) -> Session:
    """Load the graph; a device that is not available raises an OptionError."""
    return open_graph(POINTS_GRAPH, runtime, ((GRAY, MAX_KEYPOINTS), POINTS))


def detect_by_graph(
    grays: Sequence[np.ndarray],
    max_keypoints: int,
    runtime: RuntimeOptions,
    ignore: Sequence[np.ndarray | None],
    min_logit: float | None = None,
) -> list[Keypoints]:
    """Detect keypoints of all scales in (H, W) uint8 images of one size, in one run.

    Without masks, the keypoints are those of `detect_points`, up to rounding. `ignore` has a mask
    or None for each image. As the graph does not know masks, it finds more keypoints, until enough
    are outside. Some of them are others than those of `detect_points`.
    """
    session = open_points(runtime)
    images = np.stack(grays)[:, None].astype(np.float32)
    height, width = grays[0].shape
    visible = min(1.0 if mask is None else 1 - np.mean(mask != 0) for mask in ignore)
    count, short = math.ceil(max_keypoints / max(visible, 1 / 8)), True
    while short:
        inputs = {GRAY: images, MAX_KEYPOINTS: np.array([count])}
        found = run_graph(session, POINTS, inputs, f"{width}x{height} pixels")
        xys, scores = found[:2]
        wanted = [each > 0 for each in scores]
        full = [each.all() for each in wanted]
        for mask, each, xy in zip(ignore, wanted, xys, strict=True):
            each &= ~at_pixels(mask, xy)
        short = any(
            more and each.sum() < max_keypoints for more, each in zip(full, wanted, strict=True)
        )
        count *= 2
    results = []
    for each, xy, score, size, angle in zip(wanted, *found, strict=True):
        logits = ranking_logits(score)
        if min_logit is not None:
            each &= logits >= min_logit
        rows = np.flatnonzero(each)[:max_keypoints]
        results.append(
            Keypoints(
                xy[rows],
                score[rows],
                (width, height),
                logits=logits[rows],
                sizes=size[rows],
                angles=angle[rows],
            )
        )
    return results
