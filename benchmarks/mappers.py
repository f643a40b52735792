"""Compare COLMAP's two mappers on synthetic drone flights with growing numbers of images.

    python benchmarks/mappers.py [COUNT ...]

Each flight covers a relief in parallel lines; images overlap by 70 % along lines and 60 % across.
Keypoints are noisy projections of the relief's points. Each image is matched with the 20 nearest
ones; some matches are lost and others are wrong. Both mappers get the same verified pairs, and a
final bundle adjustment follows. Memory is the peak of the whole process, including Python.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.random import Generator

from deepdetect._shared.opencv import cv2
from deepdetect.batch.pair_list import SIMILAR, Pair
from deepdetect.features.keypoints import Keypoints
from deepdetect.geometry.camera import Camera, PosedView
from deepdetect.sfm.colmap import CameraIntrinsics, write_database
from deepdetect.sfm.mapping import adjust, map_globally, map_images, read_sparse_model, verify_pairs
from deepdetect_lab.evaluation.metrics.pose import camera_errors
from deepdetect_lab.evaluation.profiling import peak_memory, run_in_child

COUNTS = (60, 120, 250, 500, 1000)
SIZE, FOCAL_PX, WRONG_FOCAL = (640, 480), 600.0, 1.03
STEP, APART = 0.3 * SIZE[1], 0.4 * SIZE[0]
"""Distance between the images of a flight line, and between lines. The unit of length is the size
of a pixel on the ground. Chosen for overlaps of 70 % along lines and 60 % across them."""

RELIEF, PLACE_NOISE, TILT_DEG, NOISE_PX = 36.0, 12.0, 4.0, 0.4
"""Standard deviations of the ground's heights and the cameras' positions, in pixels on the ground,
of the cameras' angles, and of the keypoints' noise. Chosen by hand."""

SEEN_POINTS, LOST, WRONG = 1500, 0.4, 0.4
"""Mean number of points that an image shows; fraction of the matches of a pair that are lost, and
fraction of the remaining matches that are wrong. Chosen by hand."""


def fly(count: int, rng: Generator) -> tuple[list[PosedView], list[np.ndarray], list[np.ndarray]]:
    """Return the true views, and for each the indices of visible points and their positions."""
    each = -(-count // max(2, round((0.8 * count) ** 0.5)))
    line, place = np.divmod(np.arange(count), each)
    place = np.where(line % 2, each - 1 - place, place)
    ground = (line.max() + 1) * APART + SIZE[0], each * STEP + SIZE[1]
    number = round(SEEN_POINTS * ground[0] * ground[1] / (SIZE[0] * SIZE[1]))
    points = np.column_stack([rng.uniform(0, 1, (number, 2)) * ground, np.zeros(number)])
    for length in (1200, 500, 200):
        waves = rng.normal(0, 2 * np.pi / length, (2, 8))
        points[:, 2] += np.cos(points[:, :2] @ waves + rng.uniform(0, 7, 8)).sum(1)
    points[:, 2] *= RELIEF / points[:, 2].std()
    camera, views, rows, places = Camera(SIZE, FOCAL_PX), [], [], []
    for k in range(count):
        centre = np.array([line[k] * APART + SIZE[0] / 2, place[k] * STEP + SIZE[1] / 2, -FOCAL_PX])
        centre += rng.normal(0, PLACE_NOISE, 3)
        turn = rng.normal(0, np.radians(TILT_DEG), 3) + (0, 0, np.pi * (line[k] % 2))
        rotation = cv2.Rodrigues(turn * (1, 1, 0))[0] @ cv2.Rodrigues(turn * (0, 0, 1))[0]
        views.append(PosedView(f"{k:04d}.jpg", camera, rotation, -rotation @ centre))
        xy = views[-1].project(points)[0]
        rows.append(np.flatnonzero(((xy > 1) & (xy < np.array(SIZE) - 2)).all(1)))
        noisy = xy[rows[-1]] + rng.normal(0, NOISE_PX, (len(rows[-1]), 2))
        places.append(noisy.clip(0, np.array(SIZE) - 1).astype(np.float32))
    return views, rows, places


def write_flight(path: Path, count: int, rng: Generator) -> list[PosedView]:
    """Write a database of keypoints and matches, and return the true views."""
    views, rows, places = fly(count, rng)
    intrinsics = CameraIntrinsics.initial(SIZE, WRONG_FOCAL * FOCAL_PX)
    images = {
        view.name: (Keypoints(xy, np.ones(len(xy), np.float32), SIZE), intrinsics)
        for view, xy in zip(views, places, strict=True)
    }
    centres = np.array([view.centre for view in views])
    near = np.argsort(np.linalg.norm(centres[:, None] - centres, axis=2), axis=1)[:, 1:]
    pairs = {(min(k, j), max(k, j)) for k in range(count) for j in near[k, :SIMILAR].tolist()}
    matches = {}
    for one, other in sorted(pairs):
        found = np.column_stack(np.intersect1d(rows[one], rows[other], return_indices=True)[1:])
        found = found[rng.uniform(size=len(found)) > LOST]
        wrong = rng.uniform(size=len(found)) < WRONG
        found[wrong, 1] = rng.permutation(found[wrong, 1])
        matches[views[one].name, views[other].name] = found.astype(np.uint32)
    write_database(path, images, matches)
    return views


def measure(
    name: str, database: Path, truth: list[PosedView], verified: dict[Pair, int]
) -> tuple[object, ...]:
    """Reconstruct the cameras of a flight by a mapper. Call it in a separate process.

    Returns the number of registered images, the mean and the largest error of their centres in
    pixels on the ground, CPU seconds, and the peak memory of the process in megabytes.
    """
    start = time.process_time()
    if name == "global":
        model = map_globally(database, database.parent, False)[0]
    else:
        model = map_images(database, database.parent, verified, False)[0]
    adjust(model, False)
    seconds, memory = time.process_time() - start, peak_memory() / 1e6
    views = read_sparse_model(model).views
    true = [view for view in truth if view.name in views]
    errors = camera_errors([views[view.name] for view in true], true)[0]
    return len(views), errors.mean(), errors.max(), seconds, memory


def main() -> None:
    """Print a row for each number of images and mapper."""
    print("| images | mapper | registered | centres, px on the ground | largest | CPU s | MB |")
    print("|---|---|---:|---:|---:|---:|---:|")
    for count in map(int, sys.argv[1:] or COUNTS):
        with tempfile.TemporaryDirectory() as scratch:
            database = Path(scratch, "database.db")
            truth = write_flight(database, count, np.random.default_rng(count))
            verified = verify_pairs(database)
            for name in ("incremental", "global"):
                row = run_in_child(measure, name, database, truth, verified)
                cells = "| {} | {} | {} | {:.2f} | {:.2f} | {:.0f} | {:.0f} |"
                print(cells.format(count, name, *row), flush=True)


if __name__ == "__main__":
    main()
