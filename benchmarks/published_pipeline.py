"""Compare our pipeline with that of the authors' notebooks: time, memory and correct matches.

    python benchmarks/published_pipeline.py DATA [--geometry-weights dense] [--rounds 5]

DATA contains oxford/ and middlebury/. Both pipelines run end to end, from two images in memory to
the count of correct matches (wall 1-6, graf 1-3, cones). `deepdetect dev benchmark middlebury`
compares the points that both reconstruct.

The published pipeline uses torch without compilation, lists of `cv2.KeyPoint`, OpenCV's SIFT, FLANN
and loops in Python. Ours uses the default backend, dense RootSIFT and PatchMatch, without guided
matching. Both use the same weights and take turns, on images squashed to 480x480. The first round
compiles and is not counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch

from deepdetect import DeepDetect, load_image
from deepdetect.detector import HeatmapOptions
from deepdetect.geometry import disparity_errors, transform_points
from deepdetect_lab.datasets.middlebury import StereoPair, load_middlebury
from deepdetect_lab.datasets.planar import PlanarPair, load_oxford
from deepdetect_lab.evaluation.profiling import profiled
from deepdetect_lab.evaluation.protocols.paper import CORRECT_PX
from deepdetect_lab.evaluation.protocols.planar import select_pairs
from deepdetect_lab.evaluation.report import Row, Table
from deepdetect_lab.evaluation.unguided import UPRIGHT_SIFT, match_unguided
from deepdetect_lab.networks.weights import find_weights, load_network

PLANAR = (("wall", 6), ("graf", 3))
STEREO = "cones"
SIDES = ("published", "ours")
RATIO = 0.99
TREES = 5
CHECKS = 50
"""Limit of the ratio test and FLANN's settings, as in the authors' notebooks."""

Images = Sequence[np.ndarray]
Judge = Callable[[float, float, float, float], bool]
"""A function that returns whether the match of (x, y) and (u, v) is correct."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--weights", default="default")
    parser.add_argument("--geometry-weights", default="dense", help="weights for the stereo pair")
    parser.add_argument("--rounds", type=int, default=5)
    arguments = parser.parse_args()
    scenes = load_oxford(arguments.data / "oxford")
    weights = DeepDetect(arguments.weights).configured(HeatmapOptions(480))
    dense = DeepDetect(arguments.geometry_weights)
    sides = {pair.name: planar_sides(pair, weights) for pair in select_pairs(scenes, PLANAR)}
    stereo = load_middlebury(arguments.data / "middlebury" / STEREO)
    sides[STEREO] = stereo_sides(stereo, dense.configured(HeatmapOptions(480)))
    rows = [{"pair": name, **compare(*both, arguments.rounds)} for name, both in sides.items()]
    print(table(rows).to_markdown())


def table(rows: Sequence[Row]) -> Table:
    """Tabulate the rows of `compare`."""
    columns = {"pair": "", **{f"{side}, s": ".2f" for side in SIDES}}
    columns |= dict.fromkeys(("times faster", "lowest", "highest"), ".1f")
    columns |= {f"{side}: correct": ",d" for side in SIDES}
    columns |= {f"{side}: MB": ",.0f" for side in SIDES}
    return Table("correct", "correct", columns, rows)


def compare(published: Callable[[], int], ours: Callable[[], int], rounds: int) -> Row:
    """Run both in turn; return median seconds, ratios, median counts and largest memory growth."""
    profiles: list[list[tuple[float, float]]] = []
    counts: list[list[int]] = []
    for turn in range(rounds + 1):
        both: list[tuple[float, float]] = []
        found = []
        for run in (published, ours):
            with profiled() as profile:
                found.append(run())
            both.append((profile.seconds, profile.memory))
        if turn:
            profiles.append(both)
            counts.append(found)
    seconds, memory = np.moveaxis(np.array(profiles), 2, 0)
    ratios = seconds[:, 0] / seconds[:, 1]
    row: Row = {"lowest": ratios.min(), "times faster": np.median(ratios), "highest": ratios.max()}
    for k, side in enumerate(SIDES):
        row[f"{side}: correct"] = int(np.median(counts, axis=0)[k])
        row[f"{side}, s"] = float(np.median(seconds[:, k]))
        row[f"{side}: MB"] = float(memory[:, k].max() / 1e6)
    return row


def planar_sides(
    pair: PlanarPair, detector: DeepDetect
) -> tuple[Callable[[], int], Callable[[], int]]:
    """Return functions that count correct matches of a pair with a homography, for both sides."""
    matrix = pair.homography

    def one(x: float, y: float, u: float, v: float) -> bool:
        mapped = matrix @ np.array([x, y, 1.0])
        return bool(np.linalg.norm(mapped[:2] / mapped[2] - (u, v)) < CORRECT_PX)

    def every(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.linalg.norm(transform_points(first, matrix) - second, axis=1) < CORRECT_PX

    return _sides((load_image(pair.first), load_image(pair.second)), detector, one, every)


def stereo_sides(
    pair: StereoPair, detector: DeepDetect
) -> tuple[Callable[[], int], Callable[[], int]]:
    """Return functions that count correct matches of a rectified pair, for both sides."""
    disparity = pair.disparity

    def one(x: float, y: float, u: float, v: float) -> bool:
        true = disparity[round(y), round(x)]
        return bool(np.isfinite(true) and np.hypot(x - true - u, y - v) < CORRECT_PX)

    def every(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return disparity_errors(first, second, disparity) < CORRECT_PX

    return _sides((pair.left, pair.right), detector, one, every)


def _sides(
    images: Images,
    detector: DeepDetect,
    one: Judge,
    every: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> tuple[Callable[[], int], Callable[[], int]]:
    torch_detector = published_detector(detector)

    def ours() -> int:
        descriptor = replace(UPRIGHT_SIFT, name="rootsift")
        found = match_unguided(
            *images, detector, descriptor=descriptor, matcher="patchmatch", ratio=RATIO
        )
        return int(np.count_nonzero(every(found.points0, found.points1)))

    return partial(published_pipeline, images, torch_detector, one), ours


def published_detector(detector: DeepDetect) -> DeepDetect:
    """Return a detector with the same weights, which torch runs without compilation."""
    network = load_network(find_weights(detector.weights.stem))

    def run(image: np.ndarray) -> np.ndarray:
        with torch.inference_mode():
            return network(torch.from_numpy(image)).numpy()

    found = detector.configured(detector.heatmap_options)
    found._network = run
    return found


def published_pipeline(images: Images, detector: DeepDetect, correct: Judge) -> int:
    """Detect, describe and match two (H, W, 3) uint8 RGB images, and count the correct matches."""
    first, second, good = published_matches(images, detector)
    count = 0
    for match in good:
        count += correct(*first[match.queryIdx].pt, *second[match.trainIdx].pt)
    return count


def published_matches(
    images: Images, detector: DeepDetect
) -> tuple[Sequence[cv2.KeyPoint], Sequence[cv2.KeyPoint], list[cv2.DMatch]]:
    """Return the keypoints of both images, and the matches that pass the ratio test."""
    sift = cv2.SIFT_create()
    keypoints = []
    for image in images:
        mask = detector.heatmap(image) > 0.5
        keypoints.append([cv2.KeyPoint(float(x), float(y), 3) for y, x in np.argwhere(mask)])
    (first, descriptors0), (second, descriptors1) = (
        sift.compute(cv2.cvtColor(image, cv2.COLOR_RGB2BGR), own)
        for image, own in zip(images, keypoints, strict=True)
    )
    if not first or not second:
        return first, second, []
    matcher = cv2.FlannBasedMatcher({"algorithm": 1, "trees": TREES}, {"checks": CHECKS})
    good = []
    for best, next_best in matcher.knnMatch(descriptors0, descriptors1, k=2):
        if best.distance / (next_best.distance + 1e-12) < RATIO:
            good.append(best)
    return first, second, good


if __name__ == "__main__":
    main()
