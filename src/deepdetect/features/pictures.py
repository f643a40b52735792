"""Pictures of keypoints and matches, with captions, as the commands write them."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2
from ..geometry.transforms import scaled_points
from ..viz.draw import (
    add_caption,
    add_scale,
    draw_circle,
    fit_picture,
    line_scale,
    shown_range,
    viridis,
)
from .keypoints import Keypoints
from .matches import Matches
from .selection import spread_over_grid

SHOWN_KEYPOINTS, AREA_OF_KEYPOINT_PX = 1000, 200
"""Pictures show at most SHOWN_KEYPOINTS keypoints, and at most one per AREA_OF_KEYPOINT_PX square
pixels, so that viewers can tell them apart. Chosen by hand."""

LEAST_LEVEL = 0.35
"""Colours start at this level of viridis, from 0 to 1, because darker ones are hard to see."""


def draw_best_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw the best keypoints of all parts of an image, with a scale for their colours.

    The colour is the logit or, without logits, the score. At most `SHOWN_KEYPOINTS` are drawn: the
    best of each cell of a grid, then the second-best, and so on. Circles show the sizes, if known.
    """
    shown = fit_picture(rgb)
    factor = shown.shape[1] / rgb.shape[1]
    # Colours stand out better on a darkened grey copy of the image.
    gray = cv2.convertScaleAbs(cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY), alpha=0.6)
    canvas = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)
    values = keypoints.scores if keypoints.logits is None else keypoints.logits
    name = "score" if keypoints.logits is None else "logit"
    unit = line_scale(canvas)
    room = int(canvas.shape[0] * canvas.shape[1] / (AREA_OF_KEYPOINT_PX * unit**2))
    most = max(1, min(SHOWN_KEYPOINTS, room, len(keypoints)))
    # With more grid cells than drawn keypoints, the cells of the lowest scores would be empty.
    shorter, longer = sorted(canvas.shape[:2])
    cells = max(1, int((most * longer / shorter) ** 0.5))
    rows = spread_over_grid(keypoints.xy, values, keypoints.image_size, most, cells)
    counted = f"{len(rows):,} of " if len(rows) < len(keypoints) else ""
    counted += _counted(keypoints)
    if not len(rows):
        return add_caption(canvas, "no keypoints")
    low, high = shown_range(values[rows])
    levels = np.clip((values[rows] - low) / max(high - low, 1e-9), 0, 1)
    colors = viridis(LEAST_LEVEL + (1 - LEAST_LEVEL) * levels).tolist()
    radii = np.full(len(rows), 3 * unit)
    if keypoints.sizes is not None:
        radii = np.maximum(keypoints.sizes[rows] * factor / 2, 2 * unit)
    centres = scaled_points(keypoints.xy[rows], factor)
    # The best keypoints come last, on top. A dark rim makes circles visible on any background.
    for k in np.argsort(values[rows]):
        draw_circle(canvas, centres[k], radii[k], (0, 0, 0), max(2, round(2.5 * unit)))
        draw_circle(canvas, centres[k], radii[k], colors[k], max(1, round(1.25 * unit)))
    return add_scale(canvas, f"{counted}, coloured by {name}", low, high, LEAST_LEVEL)


def draw_dense_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw all keypoints, scale a large picture down, and add a caption with their number."""
    caption = f"{_counted(keypoints)}, {keypoints.density:.1%} of the pixels"
    return add_caption(fit_picture(keypoints.draw(rgb)), caption)


def _counted(keypoints: Keypoints) -> str:
    return f"{len(keypoints):,} keypoint{'' if len(keypoints) == 1 else 's'}"


def draw_all_matches(rgb0: np.ndarray, rgb1: np.ndarray, matches: Matches) -> np.ndarray:
    """Draw matches of two images, coloured by position, with a caption that counts them."""
    others = len(matches) - int(matches.inliers.sum())
    model = "none" if matches.geometry is None else matches.geometry.model
    caption = f"{len(matches):,} matches ({model}): matching points share a colour"
    if others:
        caption += f"; {others:,} that do not fit the model: red"
    return add_caption(matches.draw(rgb0, rgb1, by_position=True), caption)
