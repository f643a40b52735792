"""Draw pairs of views of one photograph with the keypoints that both show, as training sees them.

The views are those of a synthetic scene, each with its own light, blur, noise and JPEG. So depth,
occlusion and darkness are seen without any pair of real photographs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from deepdetect._shared.opencv import cv2
from deepdetect.detector.points.detection import SIZE_PER_SIGMA
from deepdetect.detector.points.hessian_scales import build_scale_space, find_candidates

from ..scenes import MARGIN_PX, correspond, draw_layers, render_layers
from ..synthetic import (
    NOISE_CELLS,
    WHITE,
    Camera,
    Effect,
    Light,
    blur,
    happens,
    record,
    relight,
    smooth_noise,
)

KEYPOINTS = 256
"""A pair has at most this many keypoints, since all are compared with all; 256 fill a view."""

LEAST_KEYPOINTS, LEAST_IF_ZOOMED, ZOOMED = 64, 40, 0.8
"""Pairs that share fewer keypoints are drawn again. Above the last log zoom the limit is lower."""

STRONGEST, MAX_FIRST_SIGMA_PX = 600, 5.1
"""Candidates in the first view that are taken at most, and their largest sigma: larger ones have no
surroundings in a view of 256 pixels."""

SIGMA_RANGE_PX = (1.0, 13.0)
"""Sigmas of keypoints in the second view: smaller ones cannot be described, larger ones not
seen."""

MIN_GROWTH = 0.02
"""Keypoints are left out if areas grow by less from the first to the second view, since such places
are seen from the side."""

CLEAN_SHARE, RANDOM_SHARE = 0.6, 0.7
"""Shares of the pairs whose keypoints are found in the view before light and noise, as a repeatable
detector would; and of which random keypoints are taken, not the strongest."""

JITTER_PX = 0.5
"""Keypoints in the first view are moved by up to half a pixel along each axis, as by a pixel
grid."""

SIZE_ERRORS, SMALL_ERROR_SHARE = (0.12, 0.4), 0.6
"""Standard deviations of the logarithm of a keypoint's size in the second view, and the share with
the smaller: detectors measure sizes with errors, of which some are large."""

PLACE_ERROR_PX, PLACE_ERROR_PER_SIGMA, PLACE_ERROR_SIGMA = 0.225, 0.162, 6.0
"""Standard deviation of a keypoint's place in the second view: pixels, and more for each pixel of
its sigma, up to this sigma."""

UNCHANGED_SHARE = 0.15
"""Share of views without changes of light, blur or noise. Chosen by hand; not measured."""

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
"""The recipe of each view, down to 1/50 of the light and to JPEG of quality 8, the least that both
are met with in use. What single ranges contribute was not measured."""

CROSS_MODAL_SHARE, MIXED_SHARE = 0.6, 0.45
"""Shares of the pairs for images of different sensors in which one view has other tones, and in
which one is of another mixture of colours."""

ONE_COLOUR_SHARE, MIXTURE_DEVIATION, LEAST_WEIGHT = 0.4, 0.6, 0.5
"""Share of the mixtures that are one colour alone; the standard deviation of the weights of the
others around 1/3; weights are divided by their sum, of absolute values, unless it is below this."""

TONES = {"negative": 0.35, "curve": 0.7, "curves": 0.88}
"""Other tones by kind, with cumulative shares; what is left is edges."""

CURVE_TONES = (3, 8)
"""Any curve of tones has 3 to 7 random values: with more it would be noise."""

EDGE_SIGMA_PX, EDGE_QUANTILE = (0.7, 1.5), 0.98
"""Edges are gradients after a blur by one of these sigmas; this quantile of them becomes white."""

DARK_EDGES_SHARE = 0.5


class Pair(NamedTuple):
    """Two views and their keypoints, row by row: arrays, or tensors with another axis for a batch.

    Attributes:
        images: (2, S, S) uint8.
        positions0, positions1: (N, 2) float32 pixels.
        sizes0, sizes1: (N,) float32 pixels.
        turns: (N,) float32 radians from the first view to the second.
        valid: (N,) bool; the other rows are padding.
        turn, zoom: of the whole view, absolute, in radians and as a logarithm.
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


def draw_pair(
    rng: np.random.Generator, files: Sequence[Path], cross_modal: bool = False
) -> Pair | None:
    """Draw a pair of views of one or of different sensors; None if they share too little."""
    layers, scales, turn = draw_layers(rng, files)
    mixtures: list[np.ndarray | None] = [None, None]
    if cross_modal and happens(rng, MIXED_SHARE):
        mixtures[int(rng.integers(2))] = draw_mixture(rng)
    rendered = (render_layers(layers, k, scales[k], mixtures[k]) for k in range(2))
    views, tops = zip(*rendered, strict=True)
    seen = [view / WHITE for view in views]
    if cross_modal and happens(rng, CROSS_MODAL_SHARE):
        other = int(rng.integers(2))
        seen[other] = change_tones(rng, seen[other])
    images = [photograph_view(rng, view) for view in seen]
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
    """Change light, sharpness and noise of a (S, S) float32 view in [0, 1]; return uint8."""
    if happens(rng, UNCHANGED_SHARE):
        return np.clip(view * WHITE, 0, WHITE).astype(np.uint8)
    view = blur(rng, relight(rng, view, LIGHT), CAMERA)
    return record(rng, np.clip(view, 0, 1) * WHITE, CAMERA)


def find_keypoints(view: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) positions and (N,) sigmas of the strongest candidates for points."""
    found = find_candidates(build_scale_space(view))
    inside = (found.xy > MARGIN_PX) & (found.xy < len(view) - 1 - MARGIN_PX)
    rows = np.flatnonzero(inside.all(1) & (found.sigma_px < MAX_FIRST_SIGMA_PX))
    rows = rows[np.argsort(found.rank[rows])][:STRONGEST]
    return found.xy[rows], found.sigma_px[rows]


def draw_mixture(rng: np.random.Generator) -> np.ndarray:
    """Draw the colour weights of a sensor, (1, 3) float32: one channel, or a mixture."""
    if happens(rng, ONE_COLOUR_SHARE):
        return np.eye(3, dtype=np.float32)[[int(rng.integers(3))]]
    weights = rng.normal(1 / 3, MIXTURE_DEVIATION, (1, 3)).astype(np.float32)
    return weights / max(LEAST_WEIGHT, np.abs(weights).sum())


def change_tones(rng: np.random.Generator, view: np.ndarray) -> np.ndarray:
    """Return a (S, S) float32 view in [0, 1] as another sensor may see it.

    The view is inverted, changed by one tone curve or by two in different areas, or shown as edges.
    """

    def curve() -> np.ndarray:
        tones = rng.random(int(rng.integers(*CURVE_TONES)))
        tones = (tones - tones.min()) / (np.ptp(tones) + 1e-6)
        return np.interp(view, np.linspace(0, 1, len(tones)), tones).astype(np.float32)

    kind = rng.random()
    if kind < TONES["negative"]:
        return 1 - view
    if kind < TONES["curve"]:
        return curve()
    if kind < TONES["curves"]:
        field = smooth_noise(rng, len(view), NOISE_CELLS)
        share = np.clip(0.5 + field / (2 * np.abs(field).max()), 0, 1)
        return curve() * share + curve() * (1 - share)
    smooth = cv2.GaussianBlur(view, (0, 0), rng.uniform(*EDGE_SIGMA_PX))
    edges = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    edges = np.clip(edges / (np.quantile(edges, EDGE_QUANTILE) + 1e-3), 0, 1)
    return 1 - edges if happens(rng, DARK_EDGES_SHARE) else edges
