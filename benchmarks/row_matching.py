"""Matching along rows, beside OpenCV's semi-global matching: points, exactness, time.

    python benchmarks/row_matching.py DATA

DATA holds the Middlebury scenes, as SCENE/left.png, right.png, disparity.png and calib.json. The
rows of each scene:

- keypoints: `match_rows` at the keypoints of the shipped geometry weights;
- every: at every pixel, as it is by default;
- edges: at every pixel, also near jumps of depth;
- complete: the same, and what only the left view shows filled from behind;
- SGBM: OpenCV's, with the range of the truth made a multiple of 16;
- SGBM, framed: both views continued to the left by that range, so that OpenCV gives values
  also where the right view shows nothing.

Shares are of the points whose true disparity is known; completeness is the share of the pixels
with known truth, hidden ones too, that have a point within 1 px of it. The truth only judges.

The true disparity of dolls is of another view than its photographs: two baselines aside. Its rows
are given as the file says, and with the truth moved to the photographs' view.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.datasets.motorcycle import load_motorcycle
from deepdetect.errors import ImageError
from deepdetect.image import load_image
from deepdetect.stereo import COMPLETE, RowMatchingOptions, match_rows

TOLERANCES = (0.5, 1.0, 2.0, 4.0)
AT_EDGES = RowMatchingOptions(uniqueness=1.0, edge_distance=0)
BASELINES_ASIDE = {"dolls": 2}
SEARCH_WITHOUT_TRUTH = 64


def main() -> None:
    """Print one line for each scene and way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder of the scenes")
    parser.add_argument("--repeats", type=int, default=3, help="the fastest counts (default: 3)")
    arguments = parser.parse_args()
    detector = DeepDetect("geometry")
    for name, left, right, truths in scenes(arguments.data):
        keypoints = detector.detect(left).xy
        for way, compute in ways(left, right, keypoints, search_count(truths)).items():
            compute()  # the first one compiles
            seconds = []
            for _ in range(arguments.repeats):
                started = time.perf_counter()
                found = compute()
                seconds.append(time.perf_counter() - started)
            for note, truth in truths.items():
                print(f"{name + note:22s} {way:22s} {judged(found, truth)} {min(seconds):6.2f} s")


def ways(
    left: np.ndarray, right: np.ndarray, keypoints: np.ndarray, count: int
) -> dict[str, Callable[[], np.ndarray]]:
    """Return what computes a map of disparities, by the name of the way."""
    row, column = np.indices(left.shape[:2])
    every = np.column_stack([column.ravel(), row.ravel()])
    return {
        f"keypoints ({len(keypoints):,})": lambda: ours(left, right, keypoints),
        f"every ({len(every):,})": lambda: ours(left, right, every),
        "edges": lambda: ours(left, right, every, AT_EDGES),
        "complete": lambda: ours(left, right, every, COMPLETE),
        "SGBM": lambda: opencv(left, right, count, 0),
        "SGBM, framed": lambda: opencv(left, right, count, count),
    }


def scenes(
    data: Path,
) -> Iterator[tuple[str, np.ndarray, np.ndarray, dict[str, np.ndarray | None]]]:
    """Yield name, both views and the truths of the Motorcycle pair and of the scenes in DATA."""
    pair = load_motorcycle()
    yield pair.name, pair.left, pair.right, {"": pair.disparity}
    for folder in sorted(path.parent for path in data.glob("*/left.png")):
        try:
            truth = load_middlebury(folder).disparity
        except ImageError:
            truths: dict[str, np.ndarray | None] = {"": None}
        else:
            truths = {"": truth}
            if folder.name in BASELINES_ASIDE:
                truths[", truth moved"] = moved(truth, BASELINES_ASIDE[folder.name])
        yield (
            folder.name,
            load_image(folder / "left.png"),
            load_image(folder / "right.png"),
            truths,
        )


def moved(disparity: np.ndarray, baselines: int) -> np.ndarray:
    """Show a true disparity from a view so many baselines to the right; NaN where hidden."""
    rows, columns = np.nonzero(np.isfinite(disparity))
    values = disparity[rows, columns]
    columns = np.rint(columns - baselines * values).astype(int)
    inside = columns >= 0
    out = np.full(disparity.shape, -np.inf, np.float32)
    np.maximum.at(out, (rows[inside], columns[inside]), values[inside])
    return np.where(np.isfinite(out), out, np.nan)


def ours(
    left: np.ndarray,
    right: np.ndarray,
    xy: np.ndarray,
    options: RowMatchingOptions = RowMatchingOptions(),
) -> np.ndarray:
    """Return a map of the matches' disparities, NaN where there is none."""
    found = match_rows(left, right, xy, options)
    out = np.full(left.shape[:2], np.nan, np.float32)
    column, row = xy[found.rows].astype(int).T
    out[row, column] = found.disparity
    return out


def search_count(truths: dict[str, np.ndarray | None]) -> int:
    """Return how many disparities OpenCV tries."""
    truth = truths[""]
    if truth is None:
        return SEARCH_WITHOUT_TRUTH
    return -(-(int(np.nanmax(truth)) + 2) // 16) * 16


def opencv(left: np.ndarray, right: np.ndarray, count: int, frame: int) -> np.ndarray:
    """Return OpenCV's disparities, NaN where it gives none."""
    matcher = cv2.StereoSGBM_create(
        minDisparity=0,
        numDisparities=count,
        blockSize=5,
        P1=8 * 3 * 25,
        P2=32 * 3 * 25,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    views = [
        cv2.copyMakeBorder(
            cv2.cvtColor(view, cv2.COLOR_RGB2BGR), 0, 0, frame, 0, cv2.BORDER_REPLICATE
        )
        for view in (left, right)
    ]
    disparity = matcher.compute(*views)[:, frame:].astype(np.float32) / 16
    return np.where(disparity >= 0, disparity, np.nan)


def judged(found: np.ndarray, truth: np.ndarray | None) -> str:
    """Return points, shares within the tolerances and completeness as text."""
    points = int(np.isfinite(found).sum())
    if truth is None:
        return f"{points:9,d}  {'no truth':37s}"
    errors = np.abs(found - truth)
    errors = errors[np.isfinite(errors)]
    shares = " ".join(f"{np.mean(errors <= tolerance):.4f}" for tolerance in TOLERANCES)
    complete = np.count_nonzero(errors <= 1) / np.count_nonzero(np.isfinite(truth))
    return f"{points:9,d}  {shares}  {complete:.4f}"


if __name__ == "__main__":
    main()
