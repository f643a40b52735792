"""Panoramas whose homographies are known: size, processor time, memory and corner errors.

    python benchmarks/stitching.py OXFORD IMAGE [--weights default] [--projection plane]

The table of docs/matching.md: Oxford's boat 1 and 2, by the published homography, and ten views of
2000x1500 pixels that are rendered of IMAGE, hung up as a flat scene: five yaws from -32 to 32
degrees at pitches of -8 and 8 degrees, rolled by up to 2 degrees, with exposures of 0.8 to 1.1. The
image is enlarged where it is smaller than what they show. Each row has a process of its own;
what numba compiles should be compiled before.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from deepdetect import DeepDetect
from deepdetect.datasets.planar import load_oxford
from deepdetect.evaluation.metrics.homography import corner_error
from deepdetect.evaluation.profiling import peak_memory, run_in_child
from deepdetect.evaluation.report import Cell, Table
from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image
from deepdetect.matching import Panorama
from deepdetect.matching.stitching import stitch
from deepdetect.matching.stitching.panorama import PROJECTIONS, Projection

SIZE_PX = (2000, 1500)
FOCAL_PX = 3700.0
YAWS_DEG = (-32, -16, 0, 16, 32)
PITCHES_DEG = (-8, 8)
MAX_ROLL_DEG = 2.0
EXPOSURES = (0.8, 1.1)
SEED = 0

COLUMNS = {
    "images": "",
    "stitched": "d",
    "panorama": "",
    "processor time, s": ".0f",
    "peak memory, GB": ".2f",
    "corner error, px: mean": ".2f",
    "least": ".2f",
    "largest": ".2f",
}


def main() -> None:
    """Print a row for each panorama."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("oxford", type=Path)
    parser.add_argument("image", type=Path)
    parser.add_argument("--weights", default="default")
    parser.add_argument("--projection", default="plane", choices=PROJECTIONS)
    arguments = parser.parse_args()
    how = arguments.weights, arguments.projection
    pair = next(one for one in load_oxford(arguments.oxford) if one.name == "boat").pairs[0]
    boat = [Path(pair.first), Path(pair.second)]
    with tempfile.TemporaryDirectory() as name:
        views = render_views(load_image(arguments.image), SIZE_PX, FOCAL_PX)
        paths = [Path(name) / f"{k}.png" for k in range(len(views))]
        for path, (image, _) in zip(paths, views, strict=True):
            cv2.imwrite(str(path), image[..., ::-1])
        truths = [truth for _, truth in views]
        del views
        rows = [
            {
                "images": "boat 1 and 2",
                **run_in_child(measure, boat, [pair.homography, np.eye(3)], *how),
            },
            {"images": "ten rendered views", **run_in_child(measure, paths, truths, *how)},
        ]
    print(Table("stitching", "Panoramas", COLUMNS, rows).to_markdown())


def measure(
    paths: Sequence[Path], truths: Sequence[np.ndarray], weights: str, projection: Projection
) -> dict[str, Cell]:
    """Stitch images; return the cells of `COLUMNS`.

    Args:
        paths: of the images.
        truths: homographies from each to one frame of all.
        weights: of the detector.
        projection: of the panorama.
    """
    started = time.process_time()
    panorama = stitch(paths, DeepDetect(weights), projection=projection)
    seconds = time.process_time() - started
    height, width = panorama.valid.shape
    memory = peak_memory() / 1e9  # before the images are read for their sizes
    errors = corner_errors(panorama, truths, [load_image(path).shape[1::-1] for path in paths])
    return {
        "stitched": len(panorama.homographies),
        "panorama": f"{width}x{height}",
        "processor time, s": seconds,
        "peak memory, GB": memory,
        "corner error, px: mean": float(np.mean(errors)),
        "least": min(errors),
        "largest": max(errors),
    }


def corner_errors(
    panorama: Panorama, truths: Sequence[np.ndarray], sizes: Sequence[tuple[int, int]]
) -> list[float]:
    """Return the mean corner error of each image but the reference, in its pixels."""
    to_reference = np.linalg.inv(panorama.homographies[panorama.reference])
    truth_to_reference = np.linalg.inv(truths[panorama.reference])
    return [
        corner_error(to_reference @ homography, truth_to_reference @ truths[k], sizes[k])
        for k, homography in panorama.homographies.items()
        if k != panorama.reference
    ]


def render_views(
    scene: np.ndarray, size: tuple[int, int], focal_px: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Render views of a flat scene by a camera that turns.

    Args:
        scene: (H, W, 3) uint8, scaled so that it just fills all views.
        size: (width, height) of the views.
        focal_px: their focal length.

    Returns:
        Views, (height, width, 3) uint8, and the homography from each to the plane of the scene.
    """
    rng = np.random.default_rng(SEED)
    right, bottom = size[0] - 1, size[1] - 1
    centred = np.array([[1, 0, -right / 2], [0, 1, -bottom / 2], [0, 0, focal_px]])
    plane = np.diag([focal_px, focal_px, 1])
    truths = []
    for pitch in PITCHES_DEG:
        for yaw in YAWS_DEG:
            roll = rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG)
            turns = np.radians(np.diag([pitch, yaw, roll]))
            about_x, about_y, about_z = (cv2.Rodrigues(turn)[0] for turn in turns)
            truths.append(plane @ about_y @ about_x @ about_z @ centred)
    corners = np.array([[0, 0], [right, 0], [right, bottom], [0, bottom]], float)
    seen = np.concatenate([transform_points(corners, truth) for truth in truths])
    first, last = seen.min(0), seen.max(0)
    whole = np.array(scene.shape[1::-1])
    scale = float(((last - first) / (whole - 1)).max())
    left, top = (first + last - scale * (whole - 1)) / 2
    hung = np.array([[scale, 0, left], [0, scale, top], [0, 0, 1]])
    views = []
    for truth in truths:
        to_view = np.linalg.inv(truth) @ hung
        view = cv2.warpPerspective(scene, to_view, size, flags=cv2.INTER_CUBIC)
        exposed = np.rint(view * rng.uniform(*EXPOSURES)).clip(0, 255)
        views.append((exposed.astype(np.uint8), truth))
    return views


if __name__ == "__main__":
    main()
