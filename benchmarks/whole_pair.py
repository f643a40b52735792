"""A whole pair, from images to counted matches: the published pipeline beside ours, in turn.

    python benchmarks/whole_pair.py DATA [--weights FILE] [--stereo-weights FILE] [--repeats 3]

DATA holds oxford/ and middlebury/. The published side does what the authors' notebook does: torch
without compilation, lists of cv2.KeyPoint, cv2.SIFT, FLANN, and loops in Python for the ratio test
and the judging. Ours: the default backend, dense RootSIFT, patchmatch, the same ratio test. Both
see images squashed to 480x480 as BGR. Correct is under 1 px by the published homography, or by the
true disparity. Seconds are medians, memory is the largest growth of the process. Needs torch.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect, HeatmapOptions, match_images
from deepdetect.benchmark.metering import metered
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.datasets.oxford import find_scene, load_oxford
from deepdetect.geometry import disparity_errors, transform_points
from deepdetect.image import load_image

RATIO = 0.99
SHOWN = HeatmapOptions(480, "bgr")


def main() -> None:
    """Print a line for each pair."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--weights", default="matching")
    parser.add_argument("--stereo-weights", default="geometry")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    for name, rgb, one, every in _pairs(arguments.data):
        weights = arguments.stereo_weights if name == "cones" else arguments.weights
        published = DeepDetect(weights, backend="torch").configured(SHOWN)
        ours = DeepDetect(weights)
        sides: dict[str, Callable[[], int]] = {
            "published": lambda: _published(rgb, published, one),  # noqa: B023
            "ours": lambda: _ours(rgb, ours, every),  # noqa: B023
        }
        seconds: dict[str, list[float]] = {side: [] for side in sides}
        memory: dict[str, float] = dict.fromkeys(sides, 0)
        correct: dict[str, int] = {}
        for turn in range(arguments.repeats + 1):  # the first compiles and is not counted
            for side, run in sides.items():
                with metered() as meter:
                    correct[side] = run()
                if turn:
                    seconds[side].append(meter.seconds)
                    memory[side] = max(memory[side], meter.memory / 1e6)
        ratios = np.array(seconds["published"]) / np.array(seconds["ours"])
        medians = {side: float(np.median(seconds[side])) for side in sides}
        print(
            f"{name}: published {medians['published']:.2f} s, ours {medians['ours']:.2f} s, "
            f"{np.median(ratios):.1f} times faster ({ratios.min():.1f} to {ratios.max():.1f}); "
            f"correct {correct['published']:,} and {correct['ours']:,}; "
            f"memory {memory['published']:,.0f} and {memory['ours']:,.0f} MB",
            flush=True,
        )


def _pairs(data: Path):  # type: ignore[no-untyped-def]
    """Yield name, both images, and how one match and how all are judged."""
    scenes = load_oxford(data / "oxford")
    for scene, number in (("wall", 6), ("graf", 3)):
        pair = list(find_scene(scenes, scene).pairs())[number - 2]
        matrix = pair.homography

        def one(x: float, y: float, u: float, v: float, matrix: np.ndarray = matrix) -> bool:
            mapped = matrix @ np.array([x, y, 1.0])
            return bool(np.linalg.norm(mapped[:2] / mapped[2] - (u, v)) < 1)

        def every(first: np.ndarray, second: np.ndarray, matrix: np.ndarray = matrix) -> np.ndarray:
            return np.linalg.norm(transform_points(first, matrix) - second, axis=1) < 1

        yield pair.name, [load_image(image) for image in (pair.first, pair.second)], one, every
    stereo = load_middlebury(data / "middlebury" / "cones")

    def near(x: float, y: float, u: float, v: float) -> bool:
        true = stereo.disparity[round(y), round(x)]
        return bool(np.isfinite(true) and np.hypot(x - true - u, y - v) < 1)

    def all_near(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return disparity_errors(first, second, stereo.disparity) < 1

    yield "cones", [stereo.left, stereo.right], near, all_near


def _published(rgb: list[np.ndarray], detector: DeepDetect, correct: Callable[..., bool]) -> int:
    sift = cv2.SIFT_create()
    described = []
    for image in rgb:
        mask = detector.heatmap(image) > 0.5
        keypoints = [cv2.KeyPoint(float(x), float(y), 3) for y, x in np.argwhere(mask)]
        described.append(sift.compute(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), keypoints))
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": 5}, {"checks": 50})
    (first, descriptors0), (second, descriptors1) = described
    good = []
    for best, next_best in matcher.knnMatch(descriptors0, descriptors1, k=2):
        if best.distance / (next_best.distance + 1e-12) < RATIO:
            good.append(best)
    count = 0
    for match in good:
        count += correct(*first[match.queryIdx].pt, *second[match.trainIdx].pt)
    return count


def _ours(
    rgb: list[np.ndarray],
    detector: DeepDetect,
    correct: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> int:
    found = match_images(
        *rgb,
        detector,
        heatmap=SHOWN,
        guidance="none",
        matcher="patchmatch",
        descriptor="rootsift",
        ratio=RATIO,
        model="none",
    )
    return int(np.count_nonzero(correct(found.points0, found.points1)))


if __name__ == "__main__":
    main()
