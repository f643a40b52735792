"""Print how far the keypoints of a photograph follow its shifts, flips and turns.

    python benchmarks/shifts_and_flips.py PHOTOS [--count 10] [--side 480] [--weights default]

The tables of docs/large-images.md: intersection over union of the keypoints (probability above
0.5) of two windows of a photograph, 16 px apart in x and y, where both show it, and of a photograph
and the same photograph flipped or turned. Time is processor time beside the network as it is.
PHOTOS are evenly chosen; the middle of each is taken, where it is larger than the side. With masks
`mask_image_NAME.png` beside photographs `image_NAME.png` these are the labels, else `fuse` makes
them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from deepdetect import DeepDetect
from deepdetect.evaluation.protocols.masks import has_samples, load_sample, sample_images
from deepdetect.io.image import find_images, load_image, luma
from deepdetect.labels import fuse

SHIFT_PX = 16
"""A multiple of the network's stride."""

BORDER_PX = 64
"""What is nearer to the border is left out of the second column."""

Logits = Callable[[np.ndarray], np.ndarray]
Change = tuple[bool, int]
"""Whether the columns are reversed, and by how many quarter turns after that."""

CHANGES: dict[str, Change] = {
    "left-right": (True, 0),
    "up-down": (True, 2),
    "90 degrees": (False, 1),
    "180 degrees": (False, 2),
    "transposed": (True, 1),
}
COPIES: dict[str, tuple[Change, ...]] = {
    "1 copy": ((False, 0),),
    "mean of 2 copies (left-right)": ((False, 0), (True, 0)),
    "mean of 4 flips": ((False, 0), (True, 0), (True, 2), (False, 2)),
    "mean of 4 turns": tuple((False, turns) for turns in range(4)),
    "mean of 8 copies": tuple((flip, turns) for flip in (False, True) for turns in range(4)),
}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--count", type=int, default=10, help="of photographs (default 10)")
    parser.add_argument("--side", type=int, default=480, help="in pixels (default 480)")
    parser.add_argument("--weights", default="default", help="name or file")
    arguments = parser.parse_args()
    detector = DeepDetect(arguments.weights, resolution="native")

    def network(image: np.ndarray) -> np.ndarray:
        return detector.heatmap_and_logits(image)[1]

    photographs = load(arguments.photographs, arguments.count, arguments.side)
    print(
        f"| windows {SHIFT_PX} px apart | overlap | {BORDER_PX} px from the border "
        "| with the labels | keypoints | time |\n|---|---|---|---|---|---|"
    )
    rows: dict[str, Logits] = {"as it is": network}
    for padding_px in (64, 128, 256):
        rows[f"{padding_px} px by reflection"] = padded(network, padding_px, "reflect")
    rows["128 px of the border's values"] = padded(network, 128, "edge")
    eight = mean_of_copies(network, COPIES["mean of 8 copies"])
    rows["mean of 8 copies"] = eight
    rows["mean of 8 copies, 128 px by reflection"] = padded(eight, 128, "reflect")
    rows["the labels themselves"] = label_logits
    seconds = []
    for name, logits in rows.items():
        started = time.process_time()
        values = shifts(logits, photographs)
        seconds.append(time.process_time() - started)
        texts = [f"{value:.3f}" for value in values] + [f"{seconds[-1] / seconds[0]:.1f}"]
        print(f"| {name} | " + " | ".join(texts) + " |", flush=True)
    print("\n| | " + " | ".join(CHANGES) + " |\n|---|" + "---|" * len(CHANGES))
    for name, copies in COPIES.items():
        logits = mean_of_copies(network, copies)
        means = flips(logits, [image for image, _ in photographs])
        print(f"| {name} | " + " | ".join(f"{mean:.3f}" for mean in means) + " |", flush=True)


def load(folder: Path, count: int, side_px: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the middles of photographs, (H, W, 3) uint8, with their labels, (H, W) bool."""
    known = has_samples(folder)
    paths = sample_images(folder) if known else find_images(folder)
    found = []
    for path in paths[:: max(1, len(paths) // count)][:count]:
        image, mask = load_sample(path) if known else (load_image(path), None)
        top, left = (max(0, (size - side_px) // 2) for size in image.shape[:2])
        here = np.s_[top : top + side_px, left : left + side_px]
        image = np.ascontiguousarray(image[here])
        found.append((image, fuse(luma(image)).mask if mask is None else mask[here]))
    return found


def shifts(
    logits: Logits, photographs: Iterable[tuple[np.ndarray, np.ndarray]]
) -> tuple[float, float, float, float]:
    """Return the overlap of windows, that far from the border, that with labels, the density."""
    rows = []
    for image, label in photographs:
        whole = logits(image) > 0
        end, begin = np.s_[SHIFT_PX:, SHIFT_PX:], np.s_[:-SHIFT_PX, :-SHIFT_PX]
        first = (logits(np.ascontiguousarray(image[begin])) > 0)[end]
        second = (logits(np.ascontiguousarray(image[end])) > 0)[begin]
        inner = np.s_[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
        far = overlap(first[inner], second[inner])
        values = overlap(first, second), far, overlap(whole, label)
        rows.append((*values, whole.mean()))
    overlaps, far, labels, density = np.mean(rows, 0).tolist()
    return overlaps, far, labels, density


def flips(logits: Logits, images: Iterable[np.ndarray]) -> list[float]:
    """Return the overlap of the keypoints under each of `CHANGES`, mean over the images."""
    rows = []
    for image in images:
        here = logits(image) > 0
        rows.append(
            [
                overlap(changed(here, change), logits(changed(image, change)) > 0)
                for change in CHANGES.values()
            ]
        )
    return [float(value) for value in np.mean(rows, 0)]


def label_logits(image: np.ndarray) -> np.ndarray:
    """Return the labels of an image as logits: 1 where it is marked, else -1."""
    return np.where(fuse(luma(image)).mask, 1.0, -1.0)


def padded(logits: Logits, padding_px: int, mode: str) -> Logits:
    """Return a network that sees the image with a margin, whose logits are cut off again."""
    inner = np.s_[padding_px:-padding_px, padding_px:-padding_px]
    margins = ((padding_px, padding_px), (padding_px, padding_px), (0, 0))
    return lambda image: logits(np.pad(image, margins, mode=mode))[inner]  # type: ignore[call-overload]


def mean_of_copies(logits: Logits, copies: Iterable[Change]) -> Logits:
    """Return a network whose logits are the mean over flipped and turned copies of the image."""
    chosen = tuple(copies)

    def run(image: np.ndarray) -> np.ndarray:
        maps = [changed_back(logits(changed(image, change)), change) for change in chosen]
        return np.mean(maps, 0)

    return run


def changed(pixels: np.ndarray, change: Change) -> np.ndarray:
    """Return an image or a map flipped and turned."""
    flip, turns = change
    return np.ascontiguousarray(np.rot90(pixels[:, ::-1] if flip else pixels, turns))


def changed_back(pixels: np.ndarray, change: Change) -> np.ndarray:
    """Return what `changed` was given."""
    flip, turns = change
    turned = np.rot90(pixels, -turns)
    return turned[:, ::-1] if flip else turned


def overlap(first: np.ndarray, second: np.ndarray) -> float:
    """Return the intersection over union of two masks; 1 where both are empty."""
    union = np.count_nonzero(first | second)
    return np.count_nonzero(first & second) / union if union else 1.0


if __name__ == "__main__":
    main()
