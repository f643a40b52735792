"""Matching with points beside dense matching: CPU seconds and correct matches.

    python benchmarks/points_matching.py --keypoints 2048

Eight pairs of the Oxford set, refined homographies. Dense guided matching; guided matching of the
best pixels of the heat map, and of points; points matched by descriptors alone. Times are CPU
seconds of the process, each way run once after one that is not counted. At the end the points of an
image of 800x640 are timed beside its heat map, on one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect import DeepDetect, MatchingOptions, PointDetector, SelectionOptions, match_images
from deepdetect._shared.machine import use_one_thread
from deepdetect.datasets.planar import PlanarPair, load_oxford
from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image

OXFORD = Path(__file__).parents[2] / "shared" / "data" / "oxford"
PAIRS = {"graf": 3, "wall": 3, "bikes": 3, "leuven": 3, "trees": 3, "ubc": 3, "boat": 6, "bark": 5}
UNGUIDED = {
    **{"guided_matching": False, "mutual": True},
    "options": MatchingOptions(ratio=0.85, descriptor="rootsift", matcher="exact"),
}


def main() -> None:
    """Print a line for each pair, and the ratios of time."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--keypoints", type=int, default=2048)
    parser.add_argument("--data", type=Path, default=OXFORD)
    arguments = parser.parse_args()
    detector, points = DeepDetect(), PointDetector(arguments.keypoints)
    pixels = SelectionOptions(max_keypoints=arguments.keypoints, nms_radius=1, subpixel=True)
    ways: Mapping[str, Mapping[str, Any]] = {
        "dense": {"detector": detector},
        "best pixels": {"detector": detector, "selection": pixels},
        "points": {"detector": points},
        "points unguided": {"detector": points, **UNGUIDED},
    }
    scenes = {scene.name: scene for scene in load_oxford(arguments.data, "refined")}
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    print("pair     " + "".join(f"{name:>28}" for name in ways))
    for scene, number in PAIRS.items():
        pair = scenes[scene].pairs[number - 2]
        cells = []
        for name, options in ways.items():
            took, count, right = measure(pair, lambda a, b, o=options: match_images(a, b, **o))
            seconds[name].append(took)
            cells.append(f"{took:6.2f} s {right:7,} of {count:7,}")
        print(f"{pair.name:9}" + "".join(f"{cell:>28}" for cell in cells), flush=True)
    dense = np.array(seconds["dense"])
    for name, values in seconds.items():
        ratio = np.exp(np.log(np.array(values) / dense).mean())
        print(f"{name}: {ratio:.2f} times the CPU seconds of dense (geometric mean)")
    image = load_image(scenes["graf"].images[0])
    ratio = points_beside_heatmap(image, arguments.keypoints)
    print(f"points of graf 1: {ratio:.2f} times the CPU seconds of its heat map, one thread")


def points_beside_heatmap(image: np.ndarray, count: int, rounds: int = 9) -> float:
    """Return the CPU seconds of points in those of the heat map, the median of rounds in turn."""
    use_one_thread()
    detector, points = DeepDetect(threads=1), PointDetector(count)
    ratios = []
    for _ in range(rounds + 1):  # the first one compiles
        begin = time.process_time()
        detector.heatmap(image)
        middle = time.process_time()
        points.detect(image)
        ratios.append((time.process_time() - middle) / (middle - begin))
    return float(np.median(ratios[1:]))


def measure(pair: PlanarPair, match: Callable[[Any, Any], Any]) -> tuple[float, int, int]:
    """Return CPU seconds, the number of matches, and how many are right within 1 px."""
    match(pair.first, pair.second)
    begin = time.process_time()
    found = match(pair.first, pair.second)
    took = time.process_time() - begin
    places = transform_points(found.points0.astype(float), pair.homography)
    right = np.linalg.norm(places - found.points1, axis=1) < 1
    return took, len(found), int(right.sum())


if __name__ == "__main__":
    main()
