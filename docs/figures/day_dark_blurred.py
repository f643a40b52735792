"""Draw the README's figure: one pair in daylight, dark and blurred, from photograph to 3D.

python docs/figures/day_dark_blurred.py           # writes docs/images/day-dark-blurred.jpg
python docs/figures/day_dark_blurred.py motion-9  # another degradation, to three-lights.jpg

The photographs are the Motorcycle pair of Middlebury 2014 (Scharstein et al., GCPR 2014; free to
use and publish with citation), which comes with scikit-image. Darkness and blur are those of
`deepdetect dev benchmark --protocol degraded`; the numbers are counted here, by ground truth.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from layout import caption, header, write_jpeg

from deepdetect import (
    Calibration,
    Camera,
    DeepDetect,
    Keypoints,
    NoDepthError,
    PointDetector,
    match_images,
    reconstruct,
)
from deepdetect.geometry import disparity_errors
from deepdetect.reconstruction import Reconstruction
from deepdetect.viz.draw import draw_circle, draw_heatmap
from deepdetect_lab.datasets import load_motorcycle
from deepdetect_lab.datasets.degradation import DEGRADATIONS, degrade
from deepdetect_lab.evaluation.clouds import draw_cloud

OUTPUT = Path(__file__).parents[1] / "images" / "day-dark-blurred.jpg"
LIGHTS = {"daylight": None, "an eighth of the light": "dark-8", "out of focus": "blur-2"}
COLUMNS = (
    "photograph, with 300 points",
    "dense: probability of a keypoint",
    "matches, left above right; red: wrong",
    "3D points, from another side",
)
FOCAL_PX, CENTRE_LEFT_PX, CENTRE_RIGHT_PX = 994.978, (311.193, 254.877), (342.279, 254.877)
BASELINE_MM = 193.001
"""Calibration of the Motorcycle pair, from `help(skimage.data.stereo_motorcycle)`."""

AZIMUTH, ELEVATION = -14, 12
"""Direction of the view of the 3D points, in degrees. Chosen by hand."""

POINTS, LINES = 300, 80
"""Numbers of points and of matches that are drawn. Chosen by hand."""

CELL = (368, 248)
ROWS_SHOWN = slice(140, 390)
"""Pixel rows of both photographs that the panel of matches shows: those of the motorcycle."""

QUALITY = 66


def main() -> None:
    """Write the figure."""
    others = {DEGRADATIONS[name].title: name for name in sys.argv[1:]}
    pair = load_motorcycle()
    detector = DeepDetect()
    rows = [header(COLUMNS, CELL[0])]
    for title, name in (others or LIGHTS).items():
        left, right = (
            view if name is None else degrade(view, DEGRADATIONS[name])
            for view in (pair.left, pair.right)
        )
        rows.append(row(title, left, right, pair.disparity, detector))
    write_jpeg(np.concatenate(rows), Path("three-lights.jpg") if others else OUTPUT, QUALITY)


def row(
    title: str, left: np.ndarray, right: np.ndarray, truth: np.ndarray, detector: DeepDetect
) -> np.ndarray:
    """Detect, match and reconstruct; return four captioned panels."""
    points = PointDetector(POINTS, spread="grid").detect(left)
    heatmap = detector.heatmap(left)
    matches = match_images(left, right, detector)
    errors = disparity_errors(matches.points0, matches.points1, truth)
    known = np.isfinite(errors)
    right_ones = errors[known] < 1
    size = (left.shape[1], left.shape[0])
    cameras = (Camera(size, FOCAL_PX, centre) for centre in (CENTRE_LEFT_PX, CENTRE_RIGHT_PX))
    try:
        model = reconstruct(left, right, calibration=Calibration(*cameras, BASELINE_MM))
        space, found = draw_model(model), f"{len(model):,} 3D points"
    except NoDepthError:
        space, found = np.full_like(left, 255), "no depth that can be trusted"
    panels = [
        (draw_points(left, points), f"{title}: the best points in yellow"),
        (draw_heatmap(heatmap), f"{len(matches.keypoints0):,} dense keypoints"),
        (
            stacked(left, right, matches.points0[known], matches.points1[known], right_ones),
            f"{len(matches):,} matches, {right_ones.mean():.1%} within 1 px",
        ),
        (space, found),
    ]
    return np.concatenate([caption(panel, text, CELL) for panel, text in panels], axis=1)


def draw_points(rgb: np.ndarray, points: Keypoints) -> np.ndarray:
    """Draw points as circles of their size, coloured from yellow (best) to blue (last)."""
    canvas = rgb.copy()
    rank = np.argsort(np.argsort(-points.scores))
    colors = draw_heatmap(1 - 0.75 * rank[None] / len(points))[0].tolist()
    for k in np.argsort(-rank):
        radius = max(points.sizes[k] / 2, 3)
        draw_circle(canvas, points.xy[k], radius, (0, 0, 0), 4)
        draw_circle(canvas, points.xy[k], radius, colors[k], 2)
    return canvas


def stacked(
    left: np.ndarray, right: np.ndarray, first: np.ndarray, second: np.ndarray, good: np.ndarray
) -> np.ndarray:
    """Draw a part of the left view above the right one, with lines for a sample of the matches."""
    from deepdetect._shared.opencv import cv2

    upper, lower = left[ROWS_SHOWN] // 2, right[ROWS_SHOWN] // 2
    canvas = np.concatenate([upper, lower])
    rows = first[:, 1]
    inside = np.flatnonzero((rows > ROWS_SHOWN.start + 4) & (rows < ROWS_SHOWN.stop - 4))
    shown = np.random.default_rng(0).permutation(inside)[:LINES]
    shown = shown[np.argsort(good[shown], kind="stable")]
    hues = np.stack([20 + 120 * first[shown, 0] / left.shape[1], *np.full((2, len(shown)), 235.0)])
    colors = cv2.cvtColor(np.rint(hues.T).astype(np.uint8)[None], cv2.COLOR_HSV2RGB)[0].tolist()
    for k, color in zip(shown, colors, strict=True):
        start = np.rint(first[k] - [0, ROWS_SHOWN.start]).astype(int).tolist()
        end = np.rint(second[k] - [0, ROWS_SHOWN.start] + [0, len(upper)]).astype(int).tolist()
        color = color if good[k] else (255, 0, 0)
        cv2.line(canvas, start, end, color, 1, cv2.LINE_AA)
        for place in (start, end):
            cv2.circle(canvas, place, 3, color, -1, cv2.LINE_AA)
    return canvas


def draw_model(model: Reconstruction) -> np.ndarray:
    """Draw the points of a model from the right and from above."""
    return draw_cloud(model.cloud, AZIMUTH, ELEVATION, (CELL[0] * 2, CELL[1] * 2))


if __name__ == "__main__":
    main()
