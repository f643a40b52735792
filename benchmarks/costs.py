"""Measure CPU seconds and memory of keypoints and matches for several image sizes.

    python benchmarks/costs.py PHOTOGRAPH PHOTOGRAPH [--rounds 3]

Two photographs of one scene are scaled to each size. Everything runs on one thread with default
options. Each cell is measured in a separate process. A first round compiles; the time is that of
the fastest later round. The memory is the peak of the process, including Python and all libraries.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from deepdetect import DeepDetect, PointDetector, load_image, match_features, match_images
from deepdetect_lab.evaluation.profiling import peak_memory, run_in_child
from deepdetect_lab.evaluation.report import Table

SIDES_PX = (640, 1600, 6000)
"""Longer sides of the images in pixels: of a video frame, of an image of about two megapixels, up
to which the network works at full resolution, and of a camera's photograph."""

POINTS = 2048

Images = list[np.ndarray]


def dense(images: Images, backend: str) -> Callable[[], object]:
    """Return a function that detects dense keypoints in the first image."""
    return partial(DeepDetect(backend=backend, threads=1).detect, images[0])


def points(images: Images) -> Callable[[], object]:
    """Return a function that detects and describes points in the first image."""
    return partial(PointDetector(POINTS).extract, images[0])


def matched_points(images: Images) -> Callable[[], object]:
    """Return a function that matches the points of both images by their descriptors."""
    detector = PointDetector(POINTS)
    return partial(match_features, *(detector.extract(image) for image in images))


def guided(images: Images) -> Callable[[], object]:
    """Return a function that matches both images, from pixels to guided matches."""
    return partial(match_images, *images, DeepDetect(threads=1))


WORK: dict[str, Callable[[Images], Callable[[], object]]] = {
    "dense, ONNX Runtime": partial(dense, backend="onnxruntime"),
    "dense, OpenVINO": partial(dense, backend="openvino"),
    f"{POINTS} points": points,
    "matching these": matched_points,
    "match_images": guided,
}


def measure(name: str, photographs: list[str], side_px: int, rounds: int) -> dict[str, object]:
    """Measure an entry of `WORK` with photographs scaled to a longer side."""
    images = [scaled(load_image(path), side_px) for path in photographs]
    work = WORK[name](images)
    seconds = []
    for _ in range(rounds + 1):
        begin = time.process_time()
        work()
        seconds.append(time.process_time() - begin)
    height, width = images[0].shape[:2]
    costs = {f"{name}, s": min(seconds[1:]), f"{name}, MB": peak_memory() / 1e6}
    return {"image, px": f"{width}x{height}", **costs}


def scaled(image: np.ndarray, side_px: int) -> np.ndarray:
    """Scale an image so that its longer side has the given length in pixels."""
    ratio = side_px / max(image.shape)
    way = cv2.INTER_AREA if ratio < 1 else cv2.INTER_CUBIC
    return cv2.resize(image, None, fx=ratio, fy=ratio, interpolation=way)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photographs", nargs=2)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    rows = []
    for side in SIDES_PX:
        row: dict[str, object] = {}
        for name in WORK:
            row |= run_in_child(measure, name, arguments.photographs, side, arguments.rounds)
        rows.append(row)
    units = {"s": ".3f", "MB": ",.0f"}
    columns = {"image, px": "", **{f"{n}, {unit}": units[unit] for n in WORK for unit in units}}
    print(Table("costs", "costs", columns, rows).to_markdown())


if __name__ == "__main__":
    main()
