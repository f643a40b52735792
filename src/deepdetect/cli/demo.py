"""`deepdetect demo`: the main job on a real stereo pair with a known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..datasets import StereoPair, load_stereo_pair
from ..detector.detector import DeepDetect, HeatmapDetector
from ..evaluation.metrics.stereo import TOLERANCE_PX, score_errors
from ..evaluation.protocols.stereo_matches import match_random_points
from ..features.display import draw_matches
from ..geometry import disparity_errors
from ..matching.pipeline import match_images
from ..viz.draw import add_caption, draw_heatmap, save_picture
from . import _options as cli
from ._detection import NETWORK


@cli.with_options(NETWORK)
def demo(
    *, output: cli.Folder = Path("demo-output"), as_json: cli.Json = False, **values: Any
) -> None:
    """Detect and match the Motorcycle stereo pair; evaluate the matches by its true disparity.

    The images (Middlebury 2014) come with the package scikit-image. Random points of the same
    number are shown for comparison: a match by chance is not to be mistaken for skill.
    """
    detector = DeepDetect(**values)
    folder = cli.output_folder(output)
    numbers = run_demo(load_stereo_pair("motorcycle"), detector, folder)
    values = {"weights": detector.weights, "backend": detector.runtime, **numbers}
    cli.print_result(as_json, values, "Correct: within 1 px of the true disparity.")


def run_demo(pair: StereoPair, detector: HeatmapDetector, folder: Path) -> dict[str, Any]:
    """Detect and match a stereo pair; evaluate the matches; write pictures.

    Args:
        pair: the two views, and the true disparity for evaluation only.
        detector: the detector.
        folder: for the pictures.

    Returns:
        `keypoints` and `density` of both images; of `all_matches`, of the `inliers` of the
        estimated geometry, and of the same number of `random` points, matched by descriptors alone,
        the number of `matches`, of `correct` ones, and the `precision`; `seconds` of the stages;
        the files of the `pictures`.
    """
    matches = match_images(pair.left, pair.right, detector)
    both = matches.keypoints0, matches.keypoints1
    errors = disparity_errors(matches.points0, matches.points1, pair.disparity)
    random = match_random_points(pair, (both[0].density + both[1].density) / 2)
    random_errors = disparity_errors(random.points0, random.points1, pair.disparity)
    sets = {"all_matches": errors, "inliers": errors[matches.inliers], "random": random_errors}
    scores = {name: score_errors(each) for name, each in sets.items()}
    known = np.isfinite(errors)
    points = matches.points0[known], matches.points1[known]
    lines = draw_matches(pair.left, pair.right, *points, errors[known] <= TOLERANCE_PX)
    caption = (
        f"{len(matches):,} matches, a random sample drawn; green: within {TOLERANCE_PX:g} px of "
        f"the true disparity ({scores['all_matches'].precision:.1%}), red: not"
    )
    heatmap = draw_heatmap(detector.heatmap(pair.left))
    pictures = {
        f"{side}_keypoints": add_caption(
            keypoints.draw(rgb),
            f"{len(keypoints):,} keypoints, density {keypoints.density:.3f}",
        )
        for side, rgb, keypoints in zip(
            ("left", "right"), (pair.left, pair.right), both, strict=True
        )
    }
    pictures["left_heatmap"] = add_caption(
        heatmap, "probability of a keypoint: dark blue 0, yellow 1"
    )
    pictures["matches"] = add_caption(lines, caption)
    paths = [folder / f"{pair.name}_{name}.jpg" for name in pictures]
    for path, picture in zip(paths, pictures.values(), strict=True):
        save_picture(picture, path)
    return {
        "keypoints": [len(each) for each in both],
        "density": [each.density for each in both],
        **{n: {**vars(each), "precision": each.precision} for n, each in scores.items()},
        "seconds": matches.seconds,
        "pictures": paths,
    }
