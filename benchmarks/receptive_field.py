"""What the network sees around a pixel, and whether tiles change what it finds.

    python benchmarks/receptive_field.py PHOTOS [--weights default] [--rounds 1]
    python benchmarks/receptive_field.py PHOTOS --mosaic mosaic.jpg [--side 10000]

The figures of docs/large-images.md. The first line prints by how much noise changes the logits far
from it, how a shift by the stride and a cut change those of a mosaic of PHOTOS, and by how much a
run in tiles differs from a run of the whole, both by ONNX Runtime. The second line writes such a
mosaic, for runs of `deepdetect detect`.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect, HeatmapOptions
from deepdetect.detector.backends.without_telemetry import import_onnxruntime
from deepdetect.detector.heatmap import MIN_TILE_MEGAPIXELS
from deepdetect.detector.tiling import DEFAULT_TILE_MEGAPIXELS, REACH_PX, STRIDE
from deepdetect.evaluation.report import Cell, Column, Table
from deepdetect.io.image import find_images, load_image
from deepdetect.viz.draw import save_picture

CELL_PX = 480
"""Photographs of a mosaic are squashed to squares of this side."""

BRIGHT_ROWS = 8
BRIGHTNESS = 1000
CHANGES = (0.1, 0.001, 0.0)
"""Of logits, whose farthest places are printed."""

STRIP_PX = (256, REACH_PX + 200)
"""Width, and length to each side, of what the distances are measured on."""

SHIFT_DISTANCES_PX = (0, 512, 1024, REACH_PX)
WHOLE_PX, CUT_PX = 3072, 1280
BANDS_PX = ((0, 16), (32, 48), (128, 192), (256, 320), (384, 448), (512, 576), (576, 640))
"""Distances from the cut."""

TILED_PX = (2500, 2077)
TILE_MEGAPIXELS = (MIN_TILE_MEGAPIXELS, 2.0, DEFAULT_TILE_MEGAPIXELS)


def main() -> None:
    """Measure and print, or write a mosaic."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--weights", default="default", help="name or ONNX file")
    parser.add_argument("--rounds", type=int, default=1, help="of the tiles (default 1)")
    parser.add_argument("--mosaic", type=Path, help="write a mosaic to this file, no more")
    parser.add_argument("--side", type=int, default=10_000, help="of it, in pixels (10000)")
    arguments = parser.parse_args()
    folder = arguments.photographs
    if arguments.mosaic is not None:
        save_picture(mosaic(folder, arguments.side, arguments.side), arguments.mosaic)
        return
    detector = DeepDetect(arguments.weights, resolution="native", backend="onnxruntime")
    changes = noise_changes(detector.weights)
    for change in CHANGES:
        print(f"logits change by over {change:g} up to {farthest(changes, change):,} px away")
    length = max(SHIFT_DISTANCES_PX) + STRIP_PX[1] - REACH_PX
    differences = shift_differences(detector, mosaic(folder, length, STRIP_PX[0]))
    for distance in SHIFT_DISTANCES_PX:
        largest = float(differences[distance:].max())
        print(f"a shift by {STRIDE} px, {distance:,} px from the border on: {largest:.1e}")
    shares = cut_shares(detector, mosaic(folder, WHOLE_PX, WHOLE_PX), CUT_PX)
    columns = tuple(Column(f"{first}-{last} px", ".3f") for first, last in BANDS_PX)
    print("\n" + Table("cut", "Changed by a cut", columns, (shares,)).to_markdown() + "\n")
    image = mosaic(folder, TILED_PX[1], TILED_PX[0])
    print(tile_table(detector, image, TILE_MEGAPIXELS, arguments.rounds).to_markdown())


def mosaic(folder: Path, height: int, width: int) -> np.ndarray:
    """Fill (height, width, 3) uint8 with the photographs of a folder, as often as it takes."""
    photographs = itertools.cycle(find_images(folder))
    found = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, CELL_PX):
        for left in range(0, width, CELL_PX):
            place = found[top : top + CELL_PX, left : left + CELL_PX]
            image = load_image(next(photographs))
            if image.shape[:2] != (CELL_PX, CELL_PX):
                image = cv2.resize(image, (CELL_PX, CELL_PX), interpolation=cv2.INTER_AREA)
            place[...] = image[: place.shape[0], : place.shape[1]]
    return found


def noise_changes(weights: Path) -> np.ndarray:
    """Return by how much logits change by their distance, from 1 px on, from rows made brighter."""
    onnxruntime = import_onnxruntime()
    session = onnxruntime.InferenceSession(str(weights), providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    width, length = STRIP_PX
    shape = (1, 3, 2 * length + BRIGHT_ROWS, width)
    noise = np.random.default_rng(0).random(shape, np.float32)
    before = session.run(["logits"], {name: noise})[0]
    noise[:, :, length : length + BRIGHT_ROWS] *= BRIGHTNESS
    changes = np.abs(session.run(["logits"], {name: noise})[0] - before).max((0, 1, 3))
    return np.maximum(changes[:length][::-1], changes[length + BRIGHT_ROWS :])


def farthest(changes: np.ndarray, above: float) -> int:
    """Return the largest distance, from 1 px on, with a change above that."""
    places = np.flatnonzero(changes > above)
    return int(places[-1]) + 1 if len(places) else 0


def shift_differences(detector: DeepDetect, image: np.ndarray) -> np.ndarray:
    """Return by how much logits differ, by their distance from a border that comes nearer."""
    whole = detector.heatmap_and_logits(image)[1][STRIDE:]
    shifted = detector.heatmap_and_logits(np.ascontiguousarray(image[STRIDE:]))[1]
    return np.abs(shifted - whole).max(1)


def cut_shares(detector: DeepDetect, image: np.ndarray, side_px: int) -> tuple[float, ...]:
    """Return how many keypoints appear or disappear in the middle square, cut out, per keypoint.

    Returns:
        Of each of `BANDS_PX`; NaN of those without keypoints.
    """
    top, left = ((length - side_px) // (2 * STRIDE) * STRIDE for length in image.shape[:2])
    middle = np.s_[top : top + side_px, left : left + side_px]
    whole = detector.heatmap_and_logits(image)[1][middle] > 0
    cut = detector.heatmap_and_logits(np.ascontiguousarray(image[middle]))[1] > 0
    steps = np.minimum(np.arange(side_px), np.arange(side_px)[::-1])
    distance = np.minimum(steps, steps[:, None])
    shares = []
    for first, last in BANDS_PX:
        here = (distance >= first) & (distance < last)
        count = np.count_nonzero(whole[here])
        changed = np.count_nonzero(whole[here] != cut[here])
        shares.append(changed / count if count else float("nan"))
    return tuple(shares)


def tile_table(
    detector: DeepDetect, image: np.ndarray, megapixels: tuple[float, ...], rounds: int
) -> Table:
    """Run an image whole and in tiles, in turns, and compare logits and processor time."""
    tiled = [detector.configured(HeatmapOptions("native", tile_megapixels=x)) for x in megapixels]
    seconds = np.empty((rounds, 1 + len(tiled)))
    maps = []
    for turn, (place, each) in itertools.product(range(rounds), enumerate([detector, *tiled])):
        started = time.process_time()
        logits = each.heatmap_and_logits(image)[1]
        seconds[turn, place] = time.process_time() - started
        if not turn:
            maps.append(logits)
    rows: list[tuple[Cell, ...]] = []
    for place, (size, found) in enumerate(zip(megapixels, maps[1:], strict=True), 1):
        largest = float(np.abs(found - maps[0]).max())
        changed = int(np.count_nonzero((found > 0) != (maps[0] > 0)))
        times = float(np.median(seconds[:, place] / seconds[:, 0]))
        rows.append((size, largest, int(np.count_nonzero(maps[0] > 0)), changed, times))
    columns = (
        Column("tiles, megapixels", ".1f"),
        Column("largest difference of logits", ".1e"),
        Column("keypoints of the whole", ",d"),
        Column("that differ", ",d"),
        Column("times its processor time", ".1f"),
    )
    return Table("tiles", "Tiles", columns, tuple(rows))


if __name__ == "__main__":
    main()
