"""Draw the figures of docs/method.md.

python docs/figures/method.py    # writes docs/images/method-*.jpg

The photographs come with scikit-image: the astronaut (NASA, public domain) and the Motorcycle pair
of Middlebury 2014 (Scharstein et al.; free to use and publish with citation).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from day_dark_blurred import POINTS, draw_points
from layout import caption, write_jpeg

from deepdetect import DeepDetect, Matches, PointDetector, match_images
from deepdetect.geometry import disparity_errors
from deepdetect.viz.draw import draw_heatmap, draw_matches
from deepdetect_lab.datasets import StereoPair, load_motorcycle
from deepdetect_lab.evaluation.unguided import UPRIGHT_SIFT, match_unguided
from deepdetect_lab.labels import LabelOptions, fuse

FOLDER = Path(__file__).parents[1] / "images"
DETECTORS = {"sift": "SIFT", "fast": "FAST", "harris": "Harris", "canny": "Canny", "sobel": "Sobel"}
CELL = (270, 270)
PAIR_CELL = (560, 189)
KIND_CELL = (560, 378)
QUALITY = 75


def main() -> None:
    """Write all figures."""
    from skimage import data

    photograph = data.astronaut()[:360, 60:420]
    write_jpeg(draw_labels(photograph), FOLDER / "method-labels.jpg", QUALITY)
    pair = load_motorcycle()
    write_jpeg(draw_kinds(pair.left), FOLDER / "method-kinds.jpg", QUALITY)
    write_jpeg(draw_guidance(pair), FOLDER / "method-guided.jpg", QUALITY)


def draw_labels(rgb: np.ndarray) -> np.ndarray:
    """Draw the masks of some detectors, the union of all nine, and the network's heat map."""
    panels = [(rgb, "a photograph")]
    for name, title in DETECTORS.items():
        mask = fuse(rgb, LabelOptions(detectors=(name,))).mask
        panels.append((_white(mask), f"{title} marks {mask.mean():.1%}"))
    union = fuse(rgb).mask
    heatmap = DeepDetect().heatmap(rgb)
    panels.append((_white(union), f"all nine together: {union.mean():.1%}"))
    panels.append((draw_heatmap(heatmap), f"the network: over 0.5 at {(heatmap > 0.5).mean():.1%}"))
    cells = [caption(panel, text, CELL) for panel, text in panels]
    return np.concatenate(
        [np.concatenate(cells[start : start + 4], axis=1) for start in range(0, len(cells), 4)]
    )


def draw_kinds(rgb: np.ndarray) -> np.ndarray:
    """Draw dense keypoints next to points."""
    detector = DeepDetect()
    dense = detector.detect(rgb)
    points = PointDetector(POINTS, spread="grid").detect(rgb)
    cells = [
        caption(dense.draw(rgb), f"dense: {len(dense):,} keypoints", KIND_CELL),
        caption(draw_points(rgb, points), f"{len(points)} points, the best in yellow", KIND_CELL),
    ]
    return np.concatenate(cells, axis=1)


def draw_guidance(pair: StereoPair) -> np.ndarray:
    """Draw matches by descriptors alone above matches that are guided by a geometry."""
    detector = DeepDetect()
    kinds = {
        "by descriptors alone": partial(match_unguided, descriptor=UPRIGHT_SIFT),
        "guided by a geometry": match_images,
    }
    cells = []
    for title, match in kinds.items():
        matches = match(pair.left, pair.right, detector)
        cells.append(_matches(pair, matches, title))
    return np.concatenate(cells, axis=1)


def _matches(pair: StereoPair, matches: Matches, title: str) -> np.ndarray:
    errors = disparity_errors(matches.points0, matches.points1, pair.disparity)
    known = np.isfinite(errors)
    right = errors[known] <= 1
    picture = draw_matches(
        pair.left, pair.right, matches.points0[known], matches.points1[known], right, lines=120
    )
    text = f"{title}: {len(matches):,} matches, {right.mean():.1%} within 1 px (green)"
    return caption(picture, text, PAIR_CELL)


def _white(mask: np.ndarray) -> np.ndarray:
    return np.repeat((mask * np.uint8(255))[..., None], 3, axis=2)


if __name__ == "__main__":
    main()
