"""SIFT of 500,000 keypoints, all at once and by OpenCV, in turn."""

from __future__ import annotations

import time

import numpy as np

from ...features.dense_sift import dense_sift
from ...features.sift import get_descriptor
from ...io.image import load_image, luma
from ..report import Cell, Column, Table
from ..workspace import Workspace

SIZES = (2.0, 3.0, 4.0, 6.0, 8.0)
KEYPOINTS = 500_000
ROUNDS = 3


def descriptor_steps() -> int:
    """Return the number of steps that `descriptor_table` reports."""
    return len(SIZES) * (ROUNDS + 1)


def descriptor_table(workspace: Workspace, image: np.ndarray | str) -> Table:
    """Describe the first pixels of an image in both ways, for several sizes of the keypoint.

    Args:
        workspace: progress.
        image: anything `load_image` takes; half a million pixels or more give the full number.
    """
    gray = luma(load_image(image))
    rows, columns = np.indices(gray.shape)
    xy = np.column_stack([columns.ravel(), rows.ravel()])[:KEYPOINTS].astype(np.float32)
    table = []
    for size in SIZES:
        table.append((size, len(xy), *_measure(workspace, gray, xy, size)))
    titles = (
        Column("size", "g"),
        Column("keypoints", ",d"),
        Column("OpenCV, s", ".2f"),
        Column("all at once, s", ".2f"),
        Column("times faster", ".1f"),
        Column("least", ".1f"),
        Column("most", ".1f"),
        Column("equal bytes", ".3%"),
        Column("largest difference", "d"),
    )
    note = (
        f"Upright (angle 0), medians of {ROUNDS} rounds after one that compiles, both in turn; "
        "faster: median, least and most of the rounds' ratios."
    )
    return Table("descriptors", "SIFT descriptors, all at once", titles, tuple(table), note)


def _measure(
    workspace: Workspace, gray: np.ndarray, xy: np.ndarray, size: float
) -> tuple[Cell, ...]:
    opencv = get_descriptor("sift-opencv")
    seconds = []
    for turn in range(ROUNDS + 1):
        started = time.perf_counter()
        one_by_one = opencv(gray, xy, size, 0.0)
        middle = time.perf_counter()
        at_once = dense_sift(gray, xy, size)
        if turn:
            seconds.append((middle - started, time.perf_counter() - middle))
        workspace.done(1, f"descriptors of size {size:g}, round {turn}")
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
