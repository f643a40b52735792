"""Measure the errors of matches before and after `refine_matches`, on the same points.

    python benchmarks/exact_matches.py DATA

DATA contains the folders oxford (with refined homographies), hpatches, fountain, entry, kitti-clip
and kitti-clip2. Images have 2,048 keypoints, matched by `match_features`: without a ratio test for
homographies, with the default one for poses.

- Oxford, HPatches: mean number per pair of matches within 1 px of the homography, and the median
  over pairs of the median error of matches within 3 px.
- synthetic: median error in pixels of matches between the first images of Oxford and synthetic
  views, which are shifted, rotated by 20 degrees and enlarged by 1.3, or shifted and blurred by
  2 px, with noise of 2 grey levels.
- deviations: median error of the aligned matches of synthetic views, in standard deviations from
  `Matches.covariances`; it is 1.18 for a normal distribution in two dimensions.
- poses: area under the curve of pose errors of `estimate_relative_pose` up to 1 and 5 degrees,
  means over five orders of the matches; 30 pairs of each clip. Refined matches have the weights of
  their covariances.
- time: median processor time of `refine_matches` per 2,048 matches of the pairs of Oxford, divided
  by that of OpenCV's SIFT for one image of 640x480.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from descriptors import CLIP_PAIRS, CLIPS, KEYPOINTS, ORDERS, RIGHT_PX

from deepdetect import Keypoints, Matches, PointDetector, match_features, refine_matches
from deepdetect.geometry import estimate_relative_pose, transfer_errors, transform_points
from deepdetect.geometry.camera import Calibration
from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.planar import PlanarPair, load_hpatches, load_oxford
from deepdetect_lab.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect_lab.evaluation.metrics.homography import area_under_curve
from deepdetect_lab.evaluation.protocols.planar import pairs_of
from deepdetect_lab.evaluation.protocols.pose import ERROR, pose_errors
from deepdetect_lab.evaluation.report import Row, Table

EXACT_PX, AUC_DEG, UNALIGNED_PX2 = 1.0, (1, 5), 0.99
BLURS_PX, ZOOM, TURN_DEG, SHIFT_PX, NOISE = (0.0, 2.0), 1.3, 20.0, (0.4, -0.3), 2.0
"""Aligned matches have variances below `UNALIGNED_PX2` square pixels, the other matches have 1. The
text at the top explains the other numbers. Chosen by hand."""


class Measured:
    """Matches of all pairs before and after refinement; features of images are cached."""

    def __init__(self, data: Path) -> None:
        self.data, self.detector = data, PointDetector(KEYPOINTS)
        self.features = cache(lambda path: self.detector.extract(load_image(path)))

    def planar(self, pairs: list[PlanarPair], seconds: list[float]) -> tuple[Row, Row]:
        """Return the columns of planar pairs; append the seconds of refinement per match."""
        counts: list[list[int]] = [[], []]
        medians: list[list[float]] = [[], []]
        for pair in pairs:
            first, second = load_image(pair.first), load_image(pair.second)
            both = self.features(pair.first), self.features(pair.second)
            found = match_features(*both, ratio=1)
            begin = time.process_time()
            refined = refine_matches(first, second, found)
            seconds.append((time.process_time() - begin) / max(len(found), 1))
            for k, matches in enumerate((found, refined)):
                errors = transfer_errors(matches.points0, matches.points1, pair.homography)
                counts[k].append(int((errors <= EXACT_PX).sum()))
                if (errors <= RIGHT_PX).any():
                    medians[k].append(float(np.median(errors[errors <= RIGHT_PX])))
        before, after = (
            {"within 1 px": float(np.mean(counts[k])), "median, px": float(np.median(medians[k]))}
            for k in (0, 1)
        )
        return before, after

    def poses(self, names: tuple[str, ...], most: int = 60) -> tuple[Row, Row]:
        """Return the areas under the curves of pose errors of some scenes."""
        errors: tuple[list[list[float]], list[list[float]]] = ([], [])
        for scene in (s for name in names for s in load_posed_scenes(self.data / name, most)):
            for pair in scene.pairs:
                paths = pair.first.path, pair.second.path
                found = match_features(*map(self.features, paths))
                refined = refine_matches(*map(load_image, paths), found)
                for own, matches in zip(errors, (found, refined), strict=True):
                    own.append([_pose_error(matches, pair, order) for order in range(ORDERS)])
        before, after = (
            {
                f"AUC {degrees}°": float(
                    np.mean([area_under_curve([*order], degrees) for order in np.transpose(own)])
                )
                for degrees in AUC_DEG
            }
            for own in errors
        )
        return before, after

    def synthetic(self, paths: list[Path]) -> tuple[Row, Row]:
        """Return the errors of matches of synthetic views, whose true positions are known."""
        errors: list[list[float]] = [[], []]
        deviations = []
        for first, second, homography in (view for path in paths for view in views(path)):
            features: list[Keypoints] = [self.detector.extract(each) for each in (first, second)]
            found = match_features(*features)
            true = transform_points(found.points0, homography)
            near = np.linalg.norm(found.points1 - true, axis=1) <= RIGHT_PX
            found, true = found[near], true[near]
            refined = refine_matches(first, second, found)
            for k, matches in enumerate((found, refined)):
                errors[k].append(float(np.median(np.linalg.norm(matches.points1 - true, axis=1))))
            deviations.append(normalised(refined, true))
        before, after = ({"synthetic, px": float(np.median(each))} for each in errors)
        return before, after | {"deviations": float(np.median(deviations))}


def _pose_error(found: Matches, pair: PosedPair, order: int) -> float:
    """Return the error in degrees of the pose from the matches in a random order."""
    pose = estimate_relative_pose(
        found.points0,
        found.points1,
        Calibration(pair.first.camera, pair.second.camera),
        seed=order,
        covariances=found.covariances,
    )
    return pose_errors(None if pose is None else (pose.rotation, pose.translation), pair)[ERROR]


def normalised(refined: Matches, true: np.ndarray) -> float:
    """Return the median error of the aligned matches in standard deviations."""
    assert refined.covariances is not None
    aligned = refined.covariances[:, 0, 0] < UNALIGNED_PX2
    off, inverse = (refined.points1 - true)[aligned], np.linalg.inv(refined.covariances[aligned])
    return float(np.median(np.sqrt(np.einsum("ni,nij,nj->n", off, inverse, off))))


def views(path: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield an image, a synthetic view of it, and the homography to the view."""
    gray = cv2.GaussianBlur(luma(load_image(path)).astype(np.float32), (0, 0), 0.8)
    height, width = gray.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), TURN_DEG, ZOOM)
    shift = np.array([[1, 0, SHIFT_PX[0]], [0, 1, SHIFT_PX[1]]])
    noise = np.random.default_rng(0).normal(0, NOISE, (2, height, width))
    for matrix, blur in ((shift, BLURS_PX[0]), (turn, BLURS_PX[0]), (shift, BLURS_PX[1])):
        seen = cv2.warpAffine(gray, matrix, (width, height), flags=cv2.INTER_LANCZOS4)
        seen = cv2.GaussianBlur(seen, (0, 0), blur) if blur else seen
        first, second = (
            np.clip(np.rint(each + own), 0, 255).astype(np.uint8)
            for each, own in zip((gray, seen), noise, strict=True)
        )
        yield first, second, np.vstack([matrix, [0, 0, 1]])


def of_sift(path: Path, rounds: int = 7) -> float:
    """Return the median processor time in seconds of OpenCV's SIFT for an image of 640x480."""
    image, sift, seconds = cv2.resize(luma(load_image(path)), (640, 480)), cv2.SIFT_create(), []
    for _ in range(rounds):
        begin = time.process_time()
        sift.detectAndCompute(image, None)
        seconds.append(time.process_time() - begin)
    return float(np.median(seconds))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-1:])
    cv2.setNumThreads(1)
    measured, seconds = Measured(data), list[float]()
    oxford = list(pairs_of(load_oxford(data / "oxford", "refined")))
    columns = {
        "Oxford": measured.planar(oxford, seconds),
        "HPatches": measured.planar(list(pairs_of(load_hpatches(data / "hpatches"))), []),
        "": measured.synthetic([*dict.fromkeys(pair.first for pair in oxford)]),
        "entry": measured.poses(("entry",)),
        "fountain": measured.poses(("fountain",)),
        "clips": measured.poses(CLIPS, CLIP_PAIRS),
    }
    rows: list[Row] = []
    for k, title in enumerate(("match_features", "and refine_matches")):
        parts = {
            f"{name}, {key}".removeprefix(", "): value
            for name, both in columns.items()
            for key, value in both[k].items()
        }
        rows.append({"method": title, **parts})
    rows[1]["time"] = KEYPOINTS * float(np.median(seconds)) / of_sift(oxford[0].first)
    styles = {name: "" if name == "method" else ".3f" for name in {**rows[0], **rows[1]}}
    styles |= {name: ".0f" for name in styles if name.endswith("within 1 px")} | {"time": ".2f"}
    print(Table("exact", "exact", styles, rows).to_markdown())


if __name__ == "__main__":
    main()
