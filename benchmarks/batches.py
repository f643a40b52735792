"""`DeepDetect.heatmap` of images of one size, run together and one by one, in turn, on two threads.

    python benchmarks/batches.py

Why `batch_size` is 1 unless it is given.
"""

from __future__ import annotations

import importlib.util
import time

import numpy as np

from deepdetect import DeepDetect
from deepdetect._shared.opencv import cv2
from deepdetect.evaluation.report import Cell, Column, Table

BACKENDS = ("onnxruntime", "openvino")
SIDES_PX = (64, 128, 240, 480)
BATCH = 8
BLUR_SIGMA_PX = 3.0
"""Of the random images: in sharp noise every pixel is a keypoint."""

ROUNDS = 9
THREADS = 2


def main() -> None:
    """Print the table."""
    table = batch_table()
    print(f"{table.to_markdown()}\n\n{table.note}")


def batch_table() -> Table:
    """Run random images of several sizes in both ways, with each backend that is installed."""
    rows: list[tuple[Cell, ...]] = []
    for backend in filter(importlib.util.find_spec, BACKENDS):
        detector = DeepDetect(backend=backend, threads=THREADS)
        for side in SIDES_PX:
            numbers = np.random.default_rng(0)
            noise = numbers.integers(0, 256, (BATCH, side, side, 3), np.uint8)
            images = [cv2.GaussianBlur(one, (0, 0), BLUR_SIGMA_PX) for one in noise]
            seconds = np.empty((ROUNDS + 1, 2))
            for turn in range(ROUNDS + 1):
                start = time.perf_counter()
                one_by_one = detector.heatmap(images)
                middle = time.perf_counter()
                together = detector.heatmap(images, batch_size=BATCH)
                seconds[turn] = middle - start, time.perf_counter() - middle
            first, second = np.median(seconds[1:], axis=0)
            apart = float(np.abs(np.subtract(one_by_one, together)).max())
            times = 1e3 * first / BATCH, 1e3 * second / BATCH, first / second
            rows.append((backend, side, *times, apart))
    titles = (
        Column("backend"),
        Column("side, px", "d"),
        Column("one by one, ms", ".1f"),
        Column(f"`batch_size={BATCH}`, ms", ".1f"),
        Column("times faster", ".2f"),
        Column("largest difference", ".1e"),
    )
    note = f"Per image; median of {ROUNDS} rounds after a first one, {THREADS} threads."
    return Table("batches", "Batches", titles, tuple(rows), note)


if __name__ == "__main__":
    main()
