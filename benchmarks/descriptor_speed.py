"""SIFT of 500,000 keypoints: all at once, and by OpenCV, in turn.

    python benchmarks/descriptor_speed.py IMAGE

IMAGE: half a million pixels or more give the full number of keypoints.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from deepdetect import load_image
from deepdetect.evaluation.report import Cell, Column, Table
from deepdetect.features.dense_sift import dense_sift
from deepdetect.features.sift import get_descriptor
from deepdetect.io.image import luma

SIZES_PX = (2.0, 3.0, 4.0, 6.0, 8.0)
KEYPOINTS = 500_000
ROUNDS = 3


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("image")
    table = descriptor_table(luma(load_image(parser.parse_args().image)))
    print(f"{table.to_markdown()}\n\n{table.note}")


def descriptor_table(gray: np.ndarray) -> Table:
    """Describe the first pixels of an image in both ways, for several sizes of the keypoint."""
    rows, columns = np.indices(gray.shape)
    xy = np.column_stack([columns.ravel(), rows.ravel()])[:KEYPOINTS].astype(np.float32)
    table = [(size, len(xy), *_measure(gray, xy, size)) for size in SIZES_PX]
    titles = (
        Column("size", "g"),
        Column("keypoints", ",d"),
        Column("OpenCV, s", ".2f"),
        Column("all at once, s", ".2f"),
        Column("times faster", ".1f"),
        Column("lowest", ".1f"),
        Column("highest", ".1f"),
        Column("equal bytes", ".3%"),
        Column("largest difference", "d"),
    )
    note = (
        f"Upright (angle 0), medians of {ROUNDS} rounds after one that compiles, both in turn; "
        "faster: median, lowest and highest of the rounds' ratios."
    )
    return Table("descriptors", "SIFT descriptors, all at once", titles, tuple(table), note)


def _measure(gray: np.ndarray, xy: np.ndarray, size: float) -> tuple[Cell, ...]:
    opencv = get_descriptor("sift-opencv")
    seconds = []
    for turn in range(ROUNDS + 1):
        started = time.perf_counter()
        one_by_one = opencv(gray, xy, size, 0.0)
        middle = time.perf_counter()
        at_once = dense_sift(gray, xy, size)
        if turn:
            seconds.append((middle - started, time.perf_counter() - middle))
    slow, fast = np.array(seconds).T
    ratios = slow / fast
    difference = np.abs(one_by_one.astype(np.int16) - at_once)
    return (
        float(np.median(slow)),
        float(np.median(fast)),
        float(np.median(ratios)),
        float(ratios.min()),
        float(ratios.max()),
        float((difference == 0).mean()),
        int(difference.max()),
    )


if __name__ == "__main__":
    main()
