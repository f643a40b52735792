"""Make labelled views for ever, beside the training that takes them: chunks of (N, 2, S, S) uint8.

    python views.py PHOTOS VALIDATION OUTPUT WORKERS

Luma and label of whole views only, since the thresholds of a label depend on the whole image.
"""

from __future__ import annotations

import os
import sys
import zlib
from itertools import count
from pathlib import Path

import cv2
import numpy as np

from deepdetect.io.image import load_image, luma, scale_short_side
from deepdetect.labels import fuse
from deepdetect.training.augmentation import augment, darken, draw_darkening

SIDES_PX = {"S": 240, "M": 480, "L": 960}
SHARES = {"S": 0.20, "M": 0.72, "L": 0.08}
CHUNKS = {"S": 16, "M": 8, "L": 2}

KINDS = {"S": (0.45, 0.25, 0.18, 0.12), "M": (0, 0.35, 0.40, 0.25), "L": (0.45, 0.25, 0.18, 0.12)}
"""Shares of: as it is, darkened, augmented, augmented and darkened."""


def view(rgb: np.ndarray, size: str, kind: int, rng: np.random.Generator) -> np.ndarray | None:
    """Return luma and label of a view, None for an image that is no square."""
    side = SIDES_PX[size]
    shown = (
        augment(rgb, side, int(rng.integers(2**32))) if kind >= 2 else scale_short_side(rgb, side)
    )
    if kind % 2:
        shown = darken(shown, draw_darkening(rng))
    return labelled(shown) if shown.shape[:2] == (side, side) else None


def labelled(rgb: np.ndarray) -> np.ndarray:
    """Return luma and label, (2, H, W) uint8."""
    gray = luma(rgb)
    return np.stack([gray, fuse(gray).mask.astype(np.uint8)])


def write(path: Path, views: list[np.ndarray]) -> None:
    """Write a chunk, whole or not at all."""
    temporary = path.with_name(f"new-{path.name}")
    np.save(temporary, np.stack(views))
    temporary.rename(path)


def work(photos: Path, validation: Path, output: Path, worker: int, workers: int) -> None:
    """Label one worker's part of the validation photographs, then views of its others for ever."""
    cv2.setNumThreads(1)
    for light in range(2):
        views = []
        for path in sorted(validation.iterdir())[worker::workers]:
            rgb = load_image(path)
            rng = np.random.default_rng(zlib.crc32(path.name.encode()))
            views.append(labelled(darken(rgb, draw_darkening(rng)) if light else rgb))
        write(output / f"val{light}-{worker}.npy", views)
    rng = np.random.default_rng([worker, 5])
    paths = [p for p in photos.iterdir() if zlib.crc32(p.name.encode()) % workers == worker]
    for number in count():
        fresh = paths[8 * number // 2 : 8 * number // 2 + 8] if number % 2 == 0 else []
        if fresh:  # every photograph as it is, once
            size, kind, chosen = "M", 0, fresh
        else:
            size = str(rng.choice(list(SHARES), p=list(SHARES.values())))
            kind = int(rng.choice(4, p=KINDS[size]))
            chosen = [paths[k] for k in rng.integers(len(paths), size=CHUNKS[size])]
        views = [view(load_image(path), size, kind, rng) for path in chosen]
        if squares := [each for each in views if each is not None]:
            write(output / f"{size}{kind}-{worker}-{number}.npy", squares)


if __name__ == "__main__":
    folders = [Path(each) for each in sys.argv[1:4]]
    for number in range(int(sys.argv[4])):
        if os.fork() == 0:
            work(*folders, number, int(sys.argv[4]))
    os.wait()
