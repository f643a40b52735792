"""`deepdetect demo`: matches of a real stereo pair, evaluated against ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import require_packages
from ..detector.detector import DeepDetect, HeatmapDetector
from ..features.keypoints import Keypoints
from ..features.pictures import draw_dense_keypoints
from ..features.sift import describe_keypoints
from ..geometry.transforms import TOLERANCE_PX, disparity_errors, score_errors
from ..io.image import luma
from ..io.picture_file import save_picture
from ..matching.pipeline import match_features, match_images
from ..viz.draw import add_caption, draw_heatmap, draw_matches
from . import _options as cli
from ._detection import NETWORK


@cli.command(NETWORK)
def demo(*, output: cli.Folder = Path("demo-output"), **values: Any) -> cli.Result:
    """Match the Motorcycle stereo pair, and evaluate the matches by its ground-truth disparity.

    The images (Middlebury 2014) come with the package scikit-image. For comparison, the same number
    of random pixels is also matched, which shows how many matches are correct by chance.
    """
    require_packages("the Motorcycle pair", "skimage")
    from skimage import data

    detector = DeepDetect(**values)
    left, right, disparity = data.stereo_motorcycle()
    numbers = run_demo(left, right, disparity, detector, cli.output_folder(output))
    values = {"weights": detector.weights, "backend": detector.runtime, **numbers}
    found, random = numbers["all_matches"], numbers["random"]
    sentence = f"{found['matches']:,} matches, {found['precision']:.0%} of them within "
    sentence += f"{TOLERANCE_PX:g} px of ground truth (random pixels: {random['precision']:.0%})"
    return cli.Result(values, cli.headed(sentence, values, "keypoints seconds pictures"))


def _random_pixels(image: np.ndarray, count: int, generator: np.random.Generator) -> Keypoints:
    height, width = image.shape[:2]
    drawn = generator.choice(height * width, min(count, height * width), replace=False)
    xy = np.column_stack([drawn % width, drawn // width])
    return describe_keypoints(luma(image), Keypoints(xy, np.ones(len(xy)), (width, height)))


def run_demo(
    left: np.ndarray,
    right: np.ndarray,
    disparity: np.ndarray,
    detector: HeatmapDetector,
    folder: Path,
) -> dict[str, Any]:
    """Match a stereo pair, and random pixels for comparison; write pictures, return the scores.

    `disparity` is the (H, W) ground truth of the left view in pixels; not finite where unknown.
    """
    matches = match_images(left, right, detector)
    both = matches.keypoints0, matches.keypoints1
    count = max(sum(len(each) for each in both) // 2, 1)
    generator = np.random.default_rng(0)
    features = [_random_pixels(image, count, generator) for image in (left, right)]
    random = match_features(*features, mutual=False)
    disparity = np.where(np.isfinite(disparity), disparity, np.nan).squeeze()
    errors = disparity_errors(matches.points0, matches.points1, disparity)
    random_errors = disparity_errors(random.points0, random.points1, disparity)
    sets = {"all_matches": errors, "inliers": errors[matches.inliers], "random": random_errors}
    scores = {name: score_errors(each) for name, each in sets.items()}
    known = np.isfinite(errors)
    points = matches.points0[known], matches.points1[known]
    lines = draw_matches(left, right, *points, errors[known] <= TOLERANCE_PX)
    caption = (
        f"{len(matches):,} matches, a random sample shown; green: within {TOLERANCE_PX:g} px of "
        f"ground truth ({scores['all_matches']['precision']:.1%}), red: wrong"
    )
    heatmap = draw_heatmap(detector.heatmap(left))
    pictures = {
        "left_keypoints": draw_dense_keypoints(left, both[0]),
        "right_keypoints": draw_dense_keypoints(right, both[1]),
        "left_heatmap": add_caption(heatmap, "probability of a keypoint: dark blue 0, yellow 1"),
        "matches": add_caption(lines, caption),
    }
    paths = {folder / f"motorcycle_{name}.jpg": picture for name, picture in pictures.items()}
    for path, picture in paths.items():
        save_picture(picture, path)
    return {
        "keypoints": [len(each) for each in both],
        "density": [each.density for each in both],
        **scores,
        "seconds": matches.seconds,
        "pictures": [*paths],
    }
