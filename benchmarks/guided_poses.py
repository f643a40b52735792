"""Relative poses from `match_images` with its defaults, beside SIFT's and what SIFT could reach.

    python benchmarks/guided_poses.py DATA [--every N]

DATA is a folder of scenes with known cameras. `deepdetect benchmark pose` compares more methods;
this leaves out unguided matching, which takes most of its time, and adds a ceiling: SIFT's matches
within 1 px of the TRUE epipolar lines, as no method can know them. What is missing there to an AUC
of 1 is the noise of right matches, of the estimator, and of the true poses themselves.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect, match_images
from deepdetect.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect.evaluation.metrics.pose import (
    EPIPOLAR_THRESHOLD_PX,
    POSE_THRESHOLDS_DEG,
    epipolar_inlier_ratio,
    pose_auc,
    rotation_error,
    translation_error,
)
from deepdetect.evaluation.protocols.pose_methods import BUDGET, RATIO, estimate_pose
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.geometry import epipolar_errors
from deepdetect.io.image import load_image, luma

Points = tuple[np.ndarray, np.ndarray]


def main() -> None:
    """Print a line for each pair, and a table for each scene."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--every", type=int, default=1, help="of the pairs, every so many-th")
    args = parser.parse_args()
    detector = DeepDetect()

    def ours(pair: PosedPair) -> Points:
        found = match_images(pair.first.path, pair.second.path, detector)
        return found.points0, found.points1

    methods: dict[str, Callable[[PosedPair], Points]] = {
        "match_images": ours,
        f"SIFT {BUDGET:,}, ratio {RATIO}": _sift_matches,
        "the same, right matches only": _right_sift_matches,
    }
    for scene in load_posed_scenes(args.data):
        errors: dict[str, list[float]] = {name: [] for name in methods}
        for pair in scene.pairs[:: args.every]:
            cells = []
            for name, match in methods.items():
                points = match(pair)
                error = _pose_error(pair, *points)
                errors[name].append(error)
                share = epipolar_inlier_ratio(*points, pair.fundamental)
                cells.append(f"{error:.2f} deg ({len(points[0]):,} matches, {share:.3f} right)")
            print(f"{pair.name}: {'; '.join(cells)}", flush=True)
        limits = " / ".join(f"{limit:g}" for limit in POSE_THRESHOLDS_DEG)
        print(f"\n| {scene.name} | AUC at {limits} degrees | median error |\n|---|---|---:|")
        for name, values in errors.items():
            areas = " / ".join(f"{pose_auc(values, limit):.3f}" for limit in POSE_THRESHOLDS_DEG)
            print(f"| {name} | {areas} | {np.median(values):.2f} |", flush=True)


@cache
def _sift(path: Path) -> Points:
    keypoints, described = cv2.SIFT_create(BUDGET).detectAndCompute(luma(load_image(path)), None)
    return cv2.KeyPoint_convert(keypoints).astype(np.float64), described.astype(np.uint8)


def _sift_matches(pair: PosedPair) -> Points:
    (points0, first), (points1, second) = _sift(pair.first.path), _sift(pair.second.path)
    found = match_descriptors(first, second, get_matcher("exact"), ratio=RATIO, mutual=True)
    return points0[found.rows0], points1[found.rows1]


def _right_sift_matches(pair: PosedPair) -> Points:
    points0, points1 = _sift_matches(pair)
    right = epipolar_errors(points0, points1, pair.fundamental) < EPIPOLAR_THRESHOLD_PX
    return points0[right], points1[right]


def _pose_error(pair: PosedPair, points0: np.ndarray, points1: np.ndarray) -> float:
    pose = estimate_pose(points0, points1, pair.first.intrinsics, pair.second.intrinsics)
    if pose is None:
        return float("inf")
    rotation, translation = pose
    return max(
        rotation_error(rotation, pair.rotation), translation_error(translation, pair.translation)
    )


if __name__ == "__main__":
    main()
