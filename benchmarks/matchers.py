"""The matchers on dense keypoints of Oxford: seconds, and how many matches are right.

    python benchmarks/matchers.py OXFORD [--weights FILE] [--repeats 2]

Matching alone is timed, by turns, with descriptors made before. Counts are by the homographies
that the data set ships.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from deepdetect import DeepDetect, HeatmapOptions, SelectionOptions, select_keypoints
from deepdetect.datasets.oxford import find_scene, load_oxford
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.features.sift import get_descriptor
from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image, luma

PAIRS = (("graf", 3), ("wall", 6), ("leuven", 6))
MATCHERS = ("flann", "faiss", "patchmatch")


def main() -> None:
    """Print a line for each pair, descriptor and matcher."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("oxford", type=Path)
    parser.add_argument("--weights", default="default")
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    scenes = load_oxford(arguments.oxford)
    detector = DeepDetect(arguments.weights).configured(HeatmapOptions(480, "bgr"))
    for scene, number in PAIRS:
        pair = list(find_scene(scenes, scene).pairs())[number - 2]
        rgb = [load_image(image) for image in (pair.first, pair.second)]
        points = [select_keypoints(detector.heatmap(image), SelectionOptions()).xy for image in rgb]
        for descriptor in ("sift", "rootsift"):
            described = [
                get_descriptor(descriptor)(luma(image), xy, 3.0, 0.0)
                for image, xy in zip(rgb, points, strict=True)
            ]
            seconds: dict[str, list[float]] = {name: [] for name in MATCHERS}
            right: dict[str, int] = {}
            for _ in range(arguments.repeats + 1):  # the first one compiles
                for name in MATCHERS:
                    started = time.perf_counter()
                    found = match_descriptors(
                        *described, get_matcher(name), positions=(points[0], points[1])
                    )
                    seconds[name].append(time.perf_counter() - started)
                    places = transform_points(points[0][found.rows0], pair.homography)
                    errors = np.linalg.norm(places - points[1][found.rows1], axis=1)
                    right[name] = int(np.count_nonzero(errors < 1))
            for name in MATCHERS:
                median = float(np.median(seconds[name][1:]))
                print(f"{pair.name} {descriptor} {name}: {median:.2f} s, {right[name]:,} right")


if __name__ == "__main__":
    main()
