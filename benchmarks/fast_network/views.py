"""Make labelled views for a training that runs at the same time, until the process is stopped.

    python benchmarks/fast_network/views.py PHOTOS VALIDATION OUTPUT WORKERS [--labels dense]

The script writes chunks of (N, 2, S, S) uint8: luma and label of views of four sizes. Views are
whole images, since the thresholds of a label depend on the whole image. `dense` labels are for
normal light only. The weights `free` are trained on the data set `photographs-free`.
"""

from __future__ import annotations

import argparse
import os
import zlib
from dataclasses import replace
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from deepdetect.io.image import load_image, luma
from deepdetect_lab.datasets.scaling import scale_short_side
from deepdetect_lab.labels import LABEL_SETTINGS, LabelOptions, fuse
from deepdetect_lab.training.augmentation import augment, darken, draw_darkening

SIDES_PX = {"S": 240, "T": 352, "M": 480, "L": 960}
SHARES = {"S": 0.16, "T": 0.14, "M": 0.64, "L": 0.06}
CHUNKS = {"S": 16, "T": 16, "M": 8, "L": 2}

SMALL = (0.2, 0.1, 0.4, 0.3)
KINDS = {"S": SMALL, "T": SMALL, "M": (0, 0.3, 0.42, 0.28), "L": (0.45, 0.25, 0.18, 0.12)}
NORMAL_KINDS = (0.4, 0, 0.6, 0)
"""Shares of views that are unchanged, darkened, augmented, and both darkened and augmented, if
labels are `dense`; `KINDS` has the shares for other labels. All shares and sizes are chosen by
hand."""


def labelled(rgb: np.ndarray, dense: bool) -> np.ndarray:
    """Return luma and label, (2, H, W) uint8."""
    gray = luma(rgb)
    options = replace(LABEL_SETTINGS["dense"], visibility="normal") if dense else LabelOptions()
    return np.stack([gray, fuse(gray, options).mask.astype(np.uint8)])


def view(
    rgb: np.ndarray, size: str, kind: int, rng: np.random.Generator, dense: bool
) -> np.ndarray | None:
    """Return luma and label of a view, or None if it is not square."""
    side = SIDES_PX[size]
    shown = (
        augment(rgb, side, int(rng.integers(2**32))) if kind >= 2 else scale_short_side(rgb, side)
    )
    if kind % 2:
        shown = darken(shown, draw_darkening(rng))
    return labelled(shown, dense) if shown.shape[:2] == (side, side) else None


def write(path: Path, views: list[np.ndarray]) -> None:
    """Write a chunk atomically."""
    temporary = path.with_name(f"new-{path.name}")
    np.save(temporary, np.stack(views))
    temporary.rename(path)


def work(given: argparse.Namespace, worker: int) -> None:
    """Label this worker's part of the validation photographs, then views of its part of PHOTOS."""
    cv2.setNumThreads(1)
    dense = given.labels == "dense"
    photos, held_out = (sorted(folder.iterdir()) for folder in (given.photos, given.validation))
    for light in range(1 if dense else 2):
        views = []
        for path in held_out[worker :: given.workers]:
            rgb = load_image(path)
            rng = np.random.default_rng(zlib.crc32(path.name.encode()))
            views.append(labelled(darken(rgb, draw_darkening(rng)) if light else rgb, dense))
        squares = [each for each in views if each.shape[1:] == (480, 480)]
        write(given.output / f"val{light}-{worker}.npy", squares)
    rng = np.random.default_rng([worker, 5, 0])
    paths = [p for p in photos if zlib.crc32(p.name.encode()) % given.workers == worker]
    rng.shuffle(paths)  # type: ignore[arg-type]  # a list, in place
    for number in count():
        fresh = paths[4 * number : 4 * number + 8] if number % 2 == 0 else []
        size, kind, chosen = "M", 0, fresh  # every photograph occurs once unchanged
        if not fresh:
            size = str(rng.choice(list(SHARES), p=list(SHARES.values())))
            kind = int(rng.choice(4, p=NORMAL_KINDS if dense else KINDS[size]))
            chosen = [paths[k] for k in rng.integers(len(paths), size=CHUNKS[size])]
        views = [view(load_image(path), size, kind, rng, dense) for path in chosen]
        if squares := [each for each in views if each is not None]:
            write(given.output / f"{size}{kind}-{worker}-{number}.npy", squares)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    for name in ("photos", "validation", "output"):
        parser.add_argument(name, type=Path)
    parser.add_argument("workers", type=int)
    parser.add_argument("--labels", choices=["paper", "dense"], default="paper")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    for process in range(arguments.workers):
        if os.fork() == 0:
            work(arguments, process)
    os.wait()
