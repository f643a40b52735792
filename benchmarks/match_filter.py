"""Compare the learned match filter with the ratio test by correct matches, on the same points.

    python benchmarks/match_filter.py DATA

DATA contains the folders oxford, hpatches, fountain, entry, kitti-clip and kitti-clip2. Images have
2,048 keypoints, matched as mutual nearest neighbours. Counts are sums over all pairs.

- A match is correct if its error is at most 3 px by the homography (Oxford, HPatches), or if its
  Sampson distance from the true epipolar geometry is at most 1.5 px (fountain, entry, clips). By
  chance, wrong matches may also be near their epipolar lines.
- "as precise by ratio": the most correct matches by a ratio test that is at least as precise as the
  filter.
- "pose": area under the curve of pose errors up to 5 degrees, a mean over five orders of the
  matches; 30 pairs of each clip.
- "unrelated": matches between the first images of successive scenes of HPatches, all wrong.
- "time": median processor time of matching one pair on one processor, divided by that of the ratio
  test.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from descriptors import CLIP_PAIRS, CLIPS, KEYPOINTS, RIGHT_PX, ROUNDS, auc, errors_in_orders

from deepdetect import Keypoints, PointDetector, match_features
from deepdetect.geometry.transforms import epipolar_errors, transfer_errors
from deepdetect.io.image import load_image
from deepdetect_lab.datasets.planar import load_hpatches, load_oxford
from deepdetect_lab.datasets.posed_images import load_posed_scenes
from deepdetect_lab.evaluation.protocols.planar import pairs_of
from deepdetect_lab.evaluation.report import Row, Table

NEAR_LINE_PX = 1.5
"""A correct match lies within this distance of its epipolar line, in pixels. Chosen by hand."""

RATIOS = np.arange(0.4, 0.99, 0.02)
"""Thresholds of the ratio test that are tried. Few matches would pass lower thresholds."""

Errors = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A function that returns the errors of (M, 2) matched positions in both images, in pixels."""


def compare(pairs: Sequence[tuple[Keypoints, Keypoints, Errors]], right_px: float) -> Row:
    """Return correct matches and precisions of the filter and of ratio tests, over all pairs."""

    def right(**how: Any) -> np.ndarray:
        parts = []
        for first, second, errors in pairs:
            found = match_features(first, second, **how)
            parts.append(errors(found.points0, found.points1) <= right_px)
        return np.concatenate(parts)

    default, kept = right(), right(filter_by="neighbours")
    by_ratio = [right(ratio=float(ratio)) for ratio in RATIOS]
    as_precise = [int(each.sum()) for each in by_ratio if each.mean() >= kept.mean()]
    most = max(as_precise, default=None)
    return {
        "ratio test": int(default.sum()),
        "its precision": float(default.mean()),
        "neighbours": int(kept.sum()),
        "precision": float(kept.mean()),
        "as precise by ratio": most,
        "gain": float(kept.sum() / most - 1) if most else None,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-1:])
    cv2.setNumThreads(1)
    rows: list[Row] = []
    for kind in ("learned", "rootsift"):
        extract = PointDetector(KEYPOINTS, descriptor=kind).extract
        features = cache(lambda path, extract=extract: extract(load_image(path)))
        planar = {
            "HPatches": pairs_of(load_hpatches(data / "hpatches")),
            "Oxford": pairs_of(load_oxford(data / "oxford", "refined")),
        }
        for name, pairs in planar.items():
            given = [
                (
                    features(pair.first),
                    features(pair.second),
                    lambda a, b, pair=pair: transfer_errors(a, b, pair.homography),
                )
                for pair in pairs
            ]
            rows.append({"descriptors": kind, "data": name, **compare(given, RIGHT_PX)})
        for name, folders in {"fountain": ["fountain"], "entry": ["entry"], "clips": CLIPS}.items():
            most = CLIP_PAIRS if name == "clips" else 60
            scenes = [s for folder in folders for s in load_posed_scenes(data / folder, most)]
            posed = [pair for scene in scenes for pair in scene.pairs]
            given = [
                (
                    features(pair.first.path),
                    features(pair.second.path),
                    lambda a, b, pair=pair: epipolar_errors(a, b, pair.fundamental),
                )
                for pair in posed
            ]
            row = {"descriptors": kind, "data": name, **compare(given, NEAR_LINE_PX)}
            for title, how in (("ratio", "ratio"), ("neighbours", "neighbours")):
                by_pair: dict[str, list[float]] = {}
                for pair, (first, second, _) in zip(posed, given, strict=True):
                    found = match_features(first, second, filter_by=how)
                    by_pair[pair.name] = errors_in_orders(found, pair)
                row[f"pose, {title}"] = auc(by_pair)
            rows.append(row)
        firsts = list(dict.fromkeys(pair.first for pair in planar["HPatches"]))
        unrelated = [(features(a), features(b)) for a, b in pairwise(firsts)]
        row = {"descriptors": kind, "data": "unrelated"}
        counts = [
            sum(len(match_features(*pair, filter_by=how)) for pair in unrelated)
            for how in ("ratio", "neighbours")
        ]
        rows.append({**row, "ratio test": counts[0], "neighbours": counts[1]})
        pair = features(planar["Oxford"][0].first), features(planar["Oxford"][0].second)
        seconds = np.array([times(*pair) for _ in range(ROUNDS)])
        own = float(np.median(seconds[:, 1]) / np.median(seconds[:, 0]))
        rows.append({"descriptors": kind, "data": "time", "ratio test": 1.0, "neighbours": own})
    styles = {"descriptors": "", "data": "", "ratio test": ",.6g", "its precision": ".3f"}
    styles |= {"neighbours": ",.6g", "precision": ".3f", "as precise by ratio": ",d", "gain": ".1%"}
    styles |= {"pose, ratio": ".3f", "pose, neighbours": ".3f"}
    print(Table("match_filter", "match_filter", styles, rows).to_markdown())


def times(first: Keypoints, second: Keypoints) -> tuple[float, float]:
    """Return the processor seconds of the ratio test and of the filter."""
    begin = time.process_time()
    match_features(first, second)
    middle = time.process_time()
    match_features(first, second, filter_by="neighbours")
    return middle - begin, time.process_time() - middle


if __name__ == "__main__":
    main()
