"""Draw training pairs: two views of a synthetic scene, and the keypoints visible in both.

Each view has its own light, blur, noise and JPEG compression.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deepdetect.detector.points.detection import SIZE_PER_SIGMA
from deepdetect.detector.points.hessian_scales import build_scale_space, find_candidates

from ..scenes import MARGIN_PX, correspond, draw_layers, render_layers
from ..synthetic import (
    WHITE,
    Camera,
    Effect,
    Light,
    blur,
    happens,
    record,
    relight,
)

KEYPOINTS = 256
"""A pair has at most this many keypoints, because the loss compares all keypoints of one view with
all keypoints of the other view. 256 keypoints cover a view of 256x256 pixels."""

LEAST_KEYPOINTS, LEAST_IF_ZOOMED, ZOOMED = 64, 40, 0.8
"""Pairs are drawn again if their views share fewer than `LEAST_KEYPOINTS` keypoints. If the
absolute log zoom between views is above `ZOOMED`, `LEAST_IF_ZOOMED` are enough. Chosen by hand."""

STRONGEST, MAX_FIRST_SIGMA_PX = 600, 5.1
"""Candidates of the first view are used if their sigma is below `MAX_FIRST_SIGMA_PX`, because areas
around larger candidates do not fit into a view of 256 pixels. At most the `STRONGEST` best are used
(chosen by hand)."""

SIGMA_RANGE_PX = (1.0, 13.0)
"""Keypoints are left out if their sigma in the second view is not in this range. Smaller keypoints
cannot be described, and the areas that describe larger ones do not fit into the view."""

MIN_GROWTH = 0.02
"""Keypoints are left out if the area around them shrinks below this fraction in the second view,
which then sees their surface at a grazing angle. Chosen by hand."""

CLEAN_SHARE, RANDOM_SHARE = 0.6, 0.7
"""`CLEAN_SHARE` is the share of the pairs whose keypoints are detected before light and noise are
changed, to simulate a repeatable detector. `RANDOM_SHARE` is the share of the pairs that keep
random keypoints instead of the strongest. Chosen by hand."""

JITTER_PX = 0.5
"""Keypoints in the first view are moved at random by up to half a pixel, as rounding would do."""

SIZE_ERRORS, SMALL_ERROR_SHARE = (0.12, 0.4), 0.6
"""Log sizes of keypoints in the second view get random errors. Their standard deviation is
`SIZE_ERRORS[0]` in the share `SMALL_ERROR_SHARE`, `SIZE_ERRORS[1]` in the rest. Chosen by hand."""

PLACE_ERROR_PX, PLACE_ERROR_PER_SIGMA, PLACE_ERROR_SIGMA = 0.225, 0.162, 6.0
"""Keypoint positions in the second view get random errors. Their standard deviation in pixels is
`PLACE_ERROR_PX` + `PLACE_ERROR_PER_SIGMA` * min(`PLACE_ERROR_SIGMA`, sigma of the keypoint).
Chosen by hand; not measured."""

UNCHANGED_SHARE = 0.15
"""Share of the views without changes of light, blur, noise or compression. Chosen by hand."""

LIGHT = Light(
    field=Effect(0.25, 0, 0.7, power=0.5),
    shadow=Effect(0.15, 0.2, 0.75),
    log_gamma=Effect(0.5, -0.8, 0.8),
    curve=0.12,
    contrast=Effect(0.5, 0.35, 1.5),
    shift=(-0.2, 0.2),
)
CAMERA = Camera(
    blur=Effect(0.35, 0.4, 3.4, power=1.5),
    motion=Effect(0.15, 3, 12),
    log_dark=Effect(0.2, math.log(0.02), math.log(0.5)),
    noise=(Effect(0.35, 1, 14),),
    jpeg=Effect(0.3, 8, 75),
)
"""Random changes of each view. They go down to 1/50 of the light and to JPEG quality 8, the lowest
values that occur in use. How much each of the ranges contributes was not measured."""


class Pair(NamedTuple):
    """Two views and their corresponding keypoints; 0 and 1 in names stand for the views.

    The values are arrays. In a batch of pairs they are tensors with a first axis (B, ...).

    Attributes:
        images: both grey views, (2, S, S) uint8.
        positions0, positions1: keypoint positions, (N, 2) float32, in pixels.
        sizes0, sizes1: keypoint sizes, (N,) float32, in pixels.
        turns: rotation from the first view to the second at each keypoint, (N,) float32 radians.
        valid: (N,) bool, false for rows that are padding.
        turn, zoom: absolute rotation in radians, and absolute logarithm of the zoom, between the
            whole views.
    """

    images: Any
    positions0: Any
    positions1: Any
    sizes0: Any
    sizes1: Any
    turns: Any
    valid: Any
    turn: Any
    zoom: Any


def draw_pair(rng: np.random.Generator, files: Sequence[Path]) -> Pair | None:
    """Draw a pair of views, or return None if they share too few keypoints."""
    layers, scales, turn = draw_layers(rng, files)
    rendered = (render_layers(layers, k, scales[k]) for k in range(2))
    views, tops = zip(*rendered, strict=True)
    images = [photograph_view(rng, view / WHITE) for view in views]
    clean = happens(rng, CLEAN_SHARE)
    xy0, sigmas0 = find_keypoints(views[0].astype(np.uint8) if clean else images[0])
    xy0 = (xy0 + rng.uniform(-JITTER_PX, JITTER_PX, xy0.shape)).astype(np.float32)
    xy1, jacobians, valid = correspond(layers, tops, xy0)
    growth = np.linalg.det(jacobians)
    errors = np.where(rng.random(len(xy0)) < SMALL_ERROR_SHARE, *SIZE_ERRORS)
    sigmas1 = sigmas0 * np.sqrt(growth.clip(min=1e-4)) * np.exp(rng.normal(0, errors))
    least, most = SIGMA_RANGE_PX
    rows = np.flatnonzero(valid & (growth > MIN_GROWTH) & (sigmas1 > least) & (sigmas1 < most))
    zoom = abs(math.log(scales[1] / scales[0]))
    if len(rows) < (LEAST_IF_ZOOMED if zoom > ZOOMED else LEAST_KEYPOINTS):
        return None
    rows = (rng.permutation(rows) if happens(rng, RANDOM_SHARE) else rows)[:KEYPOINTS]
    seen_sigmas = np.minimum(sigmas1[rows], PLACE_ERROR_SIGMA)
    error_px = PLACE_ERROR_PX + PLACE_ERROR_PER_SIGMA * seen_sigmas
    xy1[rows] += rng.normal(0, 1, (len(rows), 2)) * error_px[:, None]
    skew = jacobians[:, 1, 0] - jacobians[:, 0, 1]
    turns = np.arctan2(skew, jacobians[:, 0, 0] + jacobians[:, 1, 1])
    fields: list[Any] = [np.stack(images)]
    for values in (xy0, xy1, sigmas0 * SIZE_PER_SIGMA, sigmas1 * SIZE_PER_SIGMA, turns):
        fields.append(np.zeros((KEYPOINTS, *values.shape[1:]), np.float32))
        fields[-1][: len(rows)] = values[rows]
    fields += [np.arange(KEYPOINTS) < len(rows), np.float32(turn), np.float32(zoom)]
    return Pair(*fields)


def photograph_view(rng: np.random.Generator, view: np.ndarray) -> np.ndarray:
    """Simulate light and a camera for an (S, S) float32 view in [0, 1]; return uint8."""
    if happens(rng, UNCHANGED_SHARE):
        return np.clip(view * WHITE, 0, WHITE).astype(np.uint8)
    view = blur(rng, relight(rng, view, LIGHT), CAMERA)
    return record(rng, np.clip(view, 0, 1) * WHITE, CAMERA)


def find_keypoints(view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions (N, 2) and sigmas (N,), in pixels, of a view's strongest keypoints."""
    found = find_candidates(build_scale_space(view))
    inside = (found.xy > MARGIN_PX) & (found.xy < len(view) - 1 - MARGIN_PX)
    rows = np.flatnonzero(inside.all(1) & (found.sigma_px < MAX_FIRST_SIGMA_PX))
    rows = rows[np.argsort(found.rank[rows])][:STRONGEST]
    return found.xy[rows], found.sigma_px[rows]
