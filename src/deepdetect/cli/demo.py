"""`deepdetect demo`: the main job on a real stereo pair with a known truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._generated import generated_command
from ._options import (
    DETECTOR,
    PATH,
    json_option,
    make_detector,
    print_json,
    print_table,
    seconds_rows,
)

if TYPE_CHECKING:
    import numpy as np

    from ..datasets import StereoPair
    from ..detector.detector import HeatmapDetector
    from ..evaluation.metrics.stereo import StereoScore
    from ..features.keypoints import Keypoints
    from ..features.matches import Matches


@generated_command(DETECTOR, short_help="Match a real stereo pair, and evaluate the matches.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("demo-output"),
    show_default=True,
    help="Folder for the pictures.",
)
@json_option
def demo(output: Path, as_json: bool, **values: Any) -> None:
    """Detect and match the Motorcycle stereo pair; evaluate the matches by its true disparity.

    The photographs (Middlebury 2014) come with the package scikit-image. Random points
    of the same number are shown for comparison: a match by chance is not to be mistaken for skill.
    """
    from ..datasets import load_stereo_pair

    detector = make_detector(values)
    result = run_demo(load_stereo_pair("motorcycle"), detector, output)
    if as_json:
        print_json(result.values())
        return
    print_table(
        [
            ("network", f"{detector.weights.name}, {detector.runtime}"),
            *result.rows(),
            *seconds_rows(result.seconds),
            ("pictures", ", ".join(str(path) for path in result.pictures)),
        ],
        "The Motorcycle stereo pair (two photographs of 741x500 pixels)",
    )


@dataclass(frozen=True)
class DemoResult:
    """The numbers and pictures of the demonstration.

    Attributes:
        keypoints, density: of the left and of the right image.
        all_matches: all matches.
        inliers: those that agree with the estimated geometry.
        random: the same number of random points, matched by descriptors alone.
        seconds: time of each stage.
        pictures: files.
    """

    keypoints: tuple[int, int]
    density: tuple[float, float]
    all_matches: StereoScore
    inliers: StereoScore
    random: StereoScore
    seconds: dict[str, float]
    pictures: list[Path]

    def rows(self) -> list[tuple[str, str]]:
        """Return the table's rows: name and value."""

        def evaluated(score: StereoScore) -> str:
            return f"{score.matches:,}, of them within 1 px of the truth {score.precision:.1%}"

        return [
            ("keypoints", f"{self.keypoints[0]:,} and {self.keypoints[1]:,}"),
            ("density", f"{self.density[0]:.3f} and {self.density[1]:.3f}"),
            ("matches", evaluated(self.all_matches)),
            ("matches that fit the geometry", evaluated(self.inliers)),
            ("baseline: random points", evaluated(self.random)),
        ]

    def values(self) -> dict[str, Any]:
        """Return everything as plain values for JSON."""
        values = asdict(self)
        for name in ("all_matches", "inliers", "random"):
            values[name]["precision"] = getattr(self, name).precision
        return values


def run_demo(pair: StereoPair, detector: HeatmapDetector, folder: Path) -> DemoResult:
    """Detect and match a stereo pair; evaluate the matches; write pictures.

    Args:
        pair: the two views, and the true disparity for evaluation only.
        detector: the detector.
        folder: for the pictures.
    """
    from ..evaluation.metrics.stereo import score_errors
    from ..evaluation.protocols.stereo_matches import match_random_points
    from ..geometry import disparity_errors
    from ..matching.pipeline import match_images

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
        pictures=_draw(pair, detector.heatmap(pair.left), matches, errors, folder),
    )


def _draw(
    pair: StereoPair, heatmap: np.ndarray, matches: Matches, errors: np.ndarray, folder: Path
) -> list[Path]:
    import numpy as np

    from ..evaluation.metrics.stereo import TOLERANCE_PX, score_errors
    from ..features.display import draw_matches
    from ..viz.draw import add_caption, draw_heatmap, save_picture

    def keypoint_picture(rgb: np.ndarray, keypoints: Keypoints) -> np.ndarray:
        caption = f"{len(keypoints):,} keypoints, density {keypoints.density:.3f}"
        return add_caption(keypoints.draw(rgb), caption)

    known = np.isfinite(errors)
    points = matches.points0[known], matches.points1[known]
    lines = draw_matches(pair.left, pair.right, *points, errors[known] <= TOLERANCE_PX)
    caption = (
        f"{len(matches):,} matches, a random sample drawn; green: within {TOLERANCE_PX:g} px of "
        f"the true disparity ({score_errors(errors).precision:.1%}), red: not"
    )
    pictures = {
        "left_keypoints": keypoint_picture(pair.left, matches.keypoints0),
        "right_keypoints": keypoint_picture(pair.right, matches.keypoints1),
        "left_heatmap": add_caption(
            draw_heatmap(heatmap), "probability of a keypoint: dark blue 0, yellow 1"
        ),
        "matches": add_caption(lines, caption),
    }
    paths = {name: folder / f"{pair.name}_{name}.jpg" for name in pictures}
    for name, picture in pictures.items():
        save_picture(picture, paths[name])
    return list(paths.values())
