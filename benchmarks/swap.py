"""Compare `DeepDetectFeature2D` with `cv2.SIFT`, matched by `cv2.BFMatcher` as in the README.

    python benchmarks/swap.py DATA

DATA contains the folders fountain and entry. All pairs of images up to 4 positions apart are
matched with `crossCheck`. A match is correct if its Sampson distance is below 1.5 px.

- limit: maximum number of keypoints per image for both methods; none: the methods' own defaults.
- SIFT, ours: number of correct matches of all pairs. ratio, least: ours divided by SIFT's, for all
  pairs and for the worst pair. keypoints: mean number of ours, divided by that of SIFT.
- time: processor time of our `detectAndCompute`, divided by SIFT's; median over the images.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from deepdetect.geometry.transforms import epipolar_errors
from deepdetect.integrations.opencv import DeepDetectFeature2D
from deepdetect_lab.datasets.posed_images import PosedPair, load_posed_scenes
from deepdetect_lab.evaluation.report import Row, Table

SCENES, APART, CORRECT_PX, LIMITS = ("fountain", "entry"), 4, 1.5, (None, 2048)
"""The text at the top explains these numbers. Chosen by hand."""


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    cv2.setNumThreads(1)
    columns = {"limit": "", "pairs": ",d", "SIFT": ",d", "ours": ",d", "ratio": ".2f"}
    columns |= {"least": ".2f", "keypoints": ".2f", "time": ".2f"}
    rows = [compare(data, limit) for limit in LIMITS]
    print(Table("swap", "swap", columns, rows).to_markdown())


def compare(data: Path, limit: int | None) -> Row:
    """Match all pairs with SIFT and with our points; return a row."""
    ours = DeepDetectFeature2D(max_keypoints=limit)
    methods = cv2.SIFT_create(0 if limit is None else limit), ours
    correct: list[tuple[int, int]] = []
    counts, seconds = [], []
    for scene in (s for name in SCENES for s in load_posed_scenes(data / name)):
        described = []
        for posed in scene.images:
            image, found, times = cv2.imread(str(posed.path)), [], []
            for method in methods:
                begin = time.process_time()
                keypoints, descriptors = method.detectAndCompute(image, None)
                times.append(time.process_time() - begin)
                found.append((np.array([each.pt for each in keypoints]), descriptors))
            described.append(found)
            counts.append([len(xy) for xy, _ in found])
            seconds.append(times)
        matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
        for first, second in np.argwhere(np.triu(np.ones([len(described)] * 2), 1)).tolist():
            if second - first > APART:
                continue
            pair, numbers = PosedPair("", scene.images[first], scene.images[second]), []
            for (xy0, codes0), (xy1, codes1) in zip(
                described[first], described[second], strict=True
            ):
                matches = matcher.match(codes0, codes1)
                rows = np.array([(each.queryIdx, each.trainIdx) for each in matches]).T
                errors = epipolar_errors(xy0[rows[0]], xy1[rows[1]], pair.fundamental)
                numbers.append(int((errors < CORRECT_PX).sum()))
            correct.append((numbers[0], numbers[1]))
    sums, share = np.sum(correct, axis=0), np.divide(*np.transpose(correct)[::-1])
    times = np.median(np.divide(*np.transpose(seconds)[::-1]))
    keypoints = np.divide(*np.mean(counts, axis=0)[::-1])
    return {
        **{"limit": "none" if limit is None else f"{limit:,}", "pairs": len(correct)},
        **{"SIFT": int(sums[0]), "ours": int(sums[1]), "ratio": float(sums[1] / sums[0])},
        **{"least": float(share.min()), "keypoints": float(keypoints), "time": float(times)},
    }


if __name__ == "__main__":
    main()
