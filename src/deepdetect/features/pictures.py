"""Pictures of keypoints and matches with captions, as commands write them."""

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

SHOWN_KEYPOINTS = 1000
AREA_OF_KEYPOINT_PX = 200
"""Pixels of a small picture for each keypoint that is drawn, so that all can be told apart."""

LEAST_LEVEL = 0.35
"""Darker colours of the scale are not seen on a photograph."""


def draw_best_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw the best keypoints of all parts of an image, coloured by score or logit, with a scale.

    At most `SHOWN_KEYPOINTS`, fewer on small images: in turn the best of each cell of a grid. They
    are circles of their size, or all alike where they have none. `fit_picture` sizes the picture.
    """
    shown = fit_picture(rgb)
    factor = shown.shape[1] / rgb.shape[1]
    # A grey, darker copy, on which colours are seen.
    gray = cv2.convertScaleAbs(cv2.cvtColor(shown, cv2.COLOR_RGB2GRAY), alpha=0.6)
    canvas = cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB)
    values = keypoints.scores if keypoints.logits is None else keypoints.logits
    name = "score" if keypoints.logits is None else "logit"
    unit = line_scale(canvas)
    room = int(canvas.shape[0] * canvas.shape[1] / (AREA_OF_KEYPOINT_PX * unit**2))
    most = max(1, min(SHOWN_KEYPOINTS, room, len(keypoints)))
    # No more cells than keypoints, or the dimmest parts would be left out.
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
    # The best on top, and a dark rim, so that each is seen before any colour.
    for k in np.argsort(values[rows]):
        draw_circle(canvas, centres[k], radii[k], (0, 0, 0), max(2, round(2.5 * unit)))
        draw_circle(canvas, centres[k], radii[k], colors[k], max(1, round(1.25 * unit)))
    return add_scale(canvas, f"{counted}, coloured by {name}", low, high, LEAST_LEVEL)


def draw_dense_keypoints(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
    """Draw all keypoints, with a caption that counts them, as `fit_picture` sizes it."""
    caption = f"{_counted(keypoints)}, {keypoints.density:.1%} of the pixels"
    return add_caption(fit_picture(keypoints.draw(rgb)), caption)


def _counted(keypoints: Keypoints) -> str:
    return f"{len(keypoints):,} keypoint{'' if len(keypoints) == 1 else 's'}"


def draw_all_matches(rgb0: np.ndarray, rgb1: np.ndarray, matches: Matches) -> np.ndarray:
    """Draw matches of two images by their positions, with a caption that counts them."""
    others = len(matches) - int(matches.inliers.sum())
    model = "none" if matches.geometry is None else matches.geometry.model
    caption = f"{len(matches):,} matches ({model}): matching points share a colour"
    if others:
        caption += f"; {others:,} that do not fit it: red"
    return add_caption(matches.draw(rgb0, rgb1, by_position=True), caption)
