"""Compare RootSIFT and the learned descriptors, on the same points, by their correct matches.

    python benchmarks/descriptors.py DATA [--method edgepoint2_t32.onnx ...]

DATA contains the folders oxford, hpatches, hdr, fountain, entry, kitti-clip and kitti-clip2. It may
also contain roadscene, with the folders crop_LR_visible and cropinfrared of the public data set.

Images have 2,048 keypoints, matched as mutual nearest neighbours without a ratio test. SIFT (best
keypoints at any contrast, with RootSIFT) and methods from files have their own keypoints. The
columns are:

- HPatches, kinds of change in Oxford, dark, blurred, hdr, infrared: number of matches within 3 px
  of the ground truth, mean over pairs. The limit is 2 px for hdr, and 5 px for infrared
  (roadscene), where photographs in visible and infrared light are aligned less exactly.
- dark, blurred: matches of the first image of each Oxford scene with a copy that has 1/8 of the
  light and noise of one grey level, and with a copy blurred by a Gaussian with a sigma of 2 px.
- worst turn: matches of three of these images with copies rotated in steps of 15 degrees and
  cropped to squares, which show equal areas. The number at the worst angle is divided by that at
  the best one. Quarter turns are left out, since interpolation does not blur them.
- hdr: the exposure nearest to middle grey with each darker one; here, the sum over all pairs.
- fountain, entry, clips: area under the curve of pose errors up to 5 degrees, with the default
  ratio test. It is a mean over five orders of the matches, on which MAGSAC's result depends.
  Fountain is also measured with 512 keypoints. Clips have 30 pairs each, 1 to 20 frames apart.
- lost: number of pairs that RootSIFT on our points solves and this method does not. A pair of
  Oxford is solved if its homography has a corner error of at most 3 px, a pair of fountain or entry
  if the median pose error over the orders is at most 10 degrees.
- time: processor time of keypoints and descriptors for an image of 640x480, divided by that of
  OpenCV's SIFT with descriptors, on one processor; both are medians over alternating rounds.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from deepdetect import Keypoints, Matches, PointDetector, match_features
from deepdetect.features.sift import describe_keypoints
from deepdetect.geometry import GeometryOptions, estimate_geometry
from deepdetect.geometry.transforms import transfer_errors
from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.planar import load_hpatches, load_oxford
from deepdetect_lab.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect_lab.evaluation.baselines.external import onnx_feature
from deepdetect_lab.evaluation.metrics.homography import area_under_curve, corner_error
from deepdetect_lab.evaluation.protocols.planar import pairs_of
from deepdetect_lab.evaluation.protocols.pose import ERROR, estimate_pose, pose_errors
from deepdetect_lab.evaluation.report import Row, Table

KEYPOINTS, FEW, RIGHT_PX, RIGHT_DARK_PX, ORDERS, AUC_DEG = 2048, 512, 3.0, 2.0, 5, 5.0
RIGHT_INFRARED_PX = 5.0
FOUND_DEG, CLIPS, CLIP_PAIRS, ROUNDS = 10.0, ("kitti-clip", "kitti-clip2"), 30, 15
MIDDLE_GREY, TURNED = 118, ("boat", "graf", "wall")
"""The text at the top explains these numbers. Chosen by hand."""

Extract = Callable[[np.ndarray], Keypoints]


def methods(files: list[str]) -> dict[str, Extract]:
    """Return the functions that extract keypoints with descriptors, by name of the method."""
    found: dict[str, Extract] = {
        kind: PointDetector(KEYPOINTS, descriptor=kind).extract
        for kind in ("rootsift", "learned", "learned-free")
    }
    others = {Path(file).stem: _extract_other(file) for file in files}
    return found | {"SIFT": _extract_sift} | others


def _extract_sift(rgb: np.ndarray) -> Keypoints:
    gray = luma(rgb)
    # With OpenCV's own threshold, dark images have hardly any keypoints.
    sift = cv2.SIFT_create(KEYPOINTS, contrastThreshold=1e-3, enable_precise_upscale=True)
    found = Keypoints.from_opencv(sift.detect(gray, None), gray.shape[::-1])
    return describe_keypoints(gray, found.best(KEYPOINTS))


def _extract_other(file: str) -> Extract:
    feature = onnx_feature(file)
    return lambda rgb: feature.detect(rgb).best(KEYPOINTS)


def copies(rgb: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return modified copies of an image by kind, each with the homography that maps to it."""
    noise = np.random.default_rng(3).normal(0, 1, rgb.shape[:2])
    dark = np.clip(np.rint(luma(rgb) / 8 + noise), 0, 255).astype(np.uint8)
    dark = cv2.cvtColor(dark, cv2.COLOR_GRAY2RGB)
    made = {"dark": (dark, np.eye(3)), "blurred": (cv2.GaussianBlur(rgb, (0, 0), 2), np.eye(3))}
    height, width = rgb.shape[:2]
    side = int(min(height, width) / math.sqrt(2))
    for degrees in range(15, 360, 15):
        turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1)
        turn[:, 2] -= (width - side) / 2, (height - side) / 2
        turned = cv2.warpAffine(rgb, turn, (side, side), flags=cv2.INTER_CUBIC)
        made[f"turned {degrees}"] = turned, np.vstack([turn, [0, 0, 1]])
    return made


def measure(extract: Extract, data: Path) -> tuple[Row, set[str]]:
    """Return the columns of the table, and the names of the solved pairs."""

    @cache
    def features(path: Path) -> Keypoints:
        return extract(load_image(path))

    def errors(first: Keypoints, second: Keypoints, homography: np.ndarray) -> np.ndarray:
        found = match_features(first, second, ratio=1)
        return transfer_errors(found.points0, found.points1, homography)

    counts: dict[str, list[int]] = {}

    def count(kind: str, *pair: Any, px: float = RIGHT_PX) -> int:
        distances = errors(*pair)
        counts.setdefault(kind, []).append(int((distances <= px).sum()))
        return len(distances)

    for pair in pairs_of(load_hpatches(data / "hpatches")):
        count("HPatches", features(pair.first), features(pair.second), pair.homography)
    matched, corners = 0, {}
    pairs = pairs_of(load_oxford(data / "oxford", "refined"))
    for pair in pairs:
        both = features(pair.first), features(pair.second)
        matched += count(pair.kind, *both, pair.homography)
        found = match_features(*both, ratio=1)
        options = GeometryOptions(inlier_threshold=1.5)
        fitted = estimate_geometry(found.points0, found.points1, "homography", options=options)
        corners[pair.name] = corner_error(fitted.matrix, pair.homography, both[0].image_size)
    right = sum(sum(counts[kind]) for kind in {pair.kind for pair in pairs})
    for path in dict.fromkeys(pair.first for pair in pairs):
        for kind, (changed, homography) in copies(load_image(path)).items():
            if not kind.startswith("turned") or path.parent.name in TURNED:
                count(kind, features(path), extract(changed), homography)
    for scene in sorted((data / "hdr").iterdir()):
        greys = {path: float(luma(load_image(path)).mean()) for path in scene.glob("*.png")}
        best = min(greys, key=lambda path: abs(greys[path] - MIDDLE_GREY))
        for path in sorted(path for path in greys if greys[path] < greys[best]):
            count("hdr", features(best), features(path), np.eye(3), px=RIGHT_DARK_PX)
    for path in sorted((data / "roadscene/crop_LR_visible").glob("*.jpg")):
        other = features(data / "roadscene/cropinfrared" / path.name)
        count("infrared", features(path), other, np.eye(3), px=RIGHT_INFRARED_PX)
    means = {kind: float(np.mean(values)) for kind, values in counts.items()}
    turned = [means.pop(f"turned {degrees}") for degrees in range(15, 360, 15)]
    turned = [value for number, value in enumerate(turned, 1) if number % 6]
    poses = {name: _pose_errors(features, data, [name]) for name in ("fountain", "entry")}
    solved = {name for name, error in corners.items() if error <= RIGHT_PX}
    for by_pair in poses.values():
        solved |= {name for name, each in by_pair.items() if np.median(each) <= FOUND_DEG}
    row = {
        **means,
        "hdr": float(sum(counts["hdr"])),
        "precision": right / matched,
        "worst turn": min(turned) / max(turned),
        "within 1 px": float((np.array([*corners.values()]) <= 1).sum()),
        "within 3 px": float((np.array([*corners.values()]) <= 3).sum()),
        "fountain": auc(poses["fountain"]),
        "fountain, 512": auc(
            _pose_errors(lambda path: features(path).best(FEW), data, ["fountain"])
        ),
        "entry": auc(poses["entry"]),
        "clips": auc(_pose_errors(features, data, CLIPS, CLIP_PAIRS)),
        "time": relative_time(extract, load_image(pairs[0].first)),
    }
    return row, solved


def relative_time(extract: Extract, rgb: np.ndarray) -> float:
    """Return the processor time for an image, divided by that of OpenCV's SIFT."""
    image, sift = cv2.resize(rgb, (640, 480)), cv2.SIFT_create(KEYPOINTS)
    seconds = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        sift.detectAndCompute(luma(image), None)
        middle = time.process_time()
        extract(image)
        seconds.append((middle - begin, time.process_time() - middle))
    of_sift, own = np.median(seconds, 0)
    return float(own / of_sift)


def auc(by_pair: dict[str, list[float]]) -> float:
    """Return the area under the curve of pose errors, averaged over the orders of the matches."""
    orders = zip(*by_pair.values(), strict=True)
    return float(np.mean([area_under_curve(list(errors), AUC_DEG) for errors in orders]))


def _pose_errors(
    features: Callable[[Path], Keypoints], data: Path, names: Sequence[str], pairs: int = 60
) -> dict[str, list[float]]:
    scenes = (scene for name in names for scene in load_posed_scenes(data / name, pairs))
    return {
        pair.name: errors_in_orders(
            match_features(features(pair.first.path), features(pair.second.path)), pair
        )
        for scene in scenes
        for pair in scene.pairs
    }


def errors_in_orders(found: Matches, pair: PosedPair) -> list[float]:
    """Return the pose error in degrees for each of `ORDERS` random orders of the matches."""
    cameras = pair.first.camera.matrix, pair.second.camera.matrix
    errors = []
    for order in range(ORDERS):
        rows = np.random.default_rng(order).permutation(len(found))
        pose = estimate_pose(found.points0[rows], found.points1[rows], *cameras)
        errors.append(pose_errors(pose, pair)[ERROR])
    return errors


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--method", action="append", default=[], help="an ONNX file")
    given = parser.parse_args()
    # Runtimes start one thread per available processor.
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-1:])
    cv2.setNumThreads(1)
    rows: list[Row] = []
    first: set[str] = set()
    for name, extract in methods(given.method).items():
        row, solved = measure(extract, given.data)
        first = first or solved
        rows.append({"descriptors": name, **row, "lost": float(len(first - solved))})
        print(rows[-1], file=sys.stderr, flush=True)
    styles = dict.fromkeys(rows[0], ".0f") | {"descriptors": ""}
    shares = ("precision", "worst turn", "fountain", "fountain, 512", "entry", "clips")
    styles |= dict.fromkeys(shares, ".3f") | {"time": ".2f"}
    print(Table("descriptors", "descriptors", styles, rows).to_markdown())


if __name__ == "__main__":
    main()
