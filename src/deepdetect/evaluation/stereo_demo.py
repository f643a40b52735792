"""The main job on a stereo pair with a known truth, judged, with pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..datasets import StereoPair
from ..detector.detector import DeepDetect
from ..features.matches import Matches
from ..geometry import disparity_errors
from ..matching.pipeline import match_images
from ..viz.draw import (
    add_caption,
    draw_heatmap,
    draw_keypoints,
    draw_matches,
    save_picture,
)
from .metrics.stereo_matches import TOLERANCE, StereoScore, score_errors
from .stereo_quality import match_random_points


@dataclass(frozen=True)
class DemoResult:
    """The numbers and pictures of the demonstration.

    Attributes:
        keypoints, density: of the left and of the right image.
        all_matches: matches that pass the ratio test.
        inliers: those that agree with the estimated epipolar geometry.
        random: the same number of random points, matched the same way.
        seconds: time of each stage.
        pictures: files.
    """

    keypoints: tuple[int, int]
    density: tuple[float, float]
    all_matches: StereoScore
    inliers: StereoScore
    random: StereoScore
    seconds: dict[str, float]
    pictures: Sequence[Path]

    def rows(self) -> list[tuple[str, str]]:
        """Return the table's rows: name and value."""

        def judged(score: StereoScore) -> str:
            return (
                f"{score.matches:,}, of them within {TOLERANCE:g} px of the truth {score.share:.1%}"
            )

        return [
            ("keypoints", f"{self.keypoints[0]:,} and {self.keypoints[1]:,}"),
            ("density", f"{self.density[0]:.3f} and {self.density[1]:.3f}"),
            ("matches", judged(self.all_matches)),
            ("matches that fit the geometry", judged(self.inliers)),
            ("control: random points", judged(self.random)),
        ]

    def numbers(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        values = asdict(self)
        for name in ("all_matches", "inliers", "random"):
            values[name]["share"] = getattr(self, name).share
        return values


def run_demo(pair: StereoPair, detector: DeepDetect, folder: Path) -> DemoResult:
    """Detect and match a stereo pair; judge the matches; write pictures.

    The true disparity is used for judging only.

    Args:
        pair: the two views and the truth.
        detector: the detector.
        folder: for the pictures.
    """
    matches = match_images(pair.left, pair.right, detector)
    errors = disparity_errors(matches.points0, matches.points1, pair.disparity)
    density = (matches.keypoints0.density + matches.keypoints1.density) / 2
    random = match_random_points(pair, density)
    random_errors = disparity_errors(random.points0, random.points1, pair.disparity)
    return DemoResult(
        keypoints=(len(matches.keypoints0), len(matches.keypoints1)),
        density=(matches.keypoints0.density, matches.keypoints1.density),
        all_matches=score_errors(errors),
        inliers=score_errors(errors[matches.inliers]),
        random=score_errors(random_errors),
        seconds=matches.seconds,
        pictures=_draw(pair, detector, matches, errors, folder),
    )


def _draw(
    pair: StereoPair, detector: DeepDetect, matches: Matches, errors: np.ndarray, folder: Path
) -> list[Path]:
    known = np.isfinite(errors)
    share = score_errors(errors).share
    lines = draw_matches(
        pair.left,
        pair.right,
        matches.points0[known],
        matches.points1[known],
        errors[known] <= TOLERANCE,
    )
    caption = (
        f"{len(matches):,} matches, a random sample drawn; "
        f"green: within {TOLERANCE:g} px of the true disparity ({share:.1%}), red: not"
    )
    pictures = {
        "left_keypoints": _keypoint_picture(pair.left, matches.keypoints0),
        "right_keypoints": _keypoint_picture(pair.right, matches.keypoints1),
        "left_heatmap": add_caption(
            draw_heatmap(detector.heatmap(pair.left)),
            "probability of a keypoint: dark blue 0, yellow 1",
        ),
        "matches": add_caption(lines, caption),
    }
    paths = []
    for name, picture in pictures.items():
        paths.append(folder / f"{pair.name}_{name}.png")
        save_picture(picture, paths[-1])
    return paths


def _keypoint_picture(rgb: np.ndarray, keypoints: Any) -> np.ndarray:
    caption = f"{len(keypoints):,} keypoints, density {keypoints.density:.3f}"
    return add_caption(draw_keypoints(rgb, keypoints), caption)
