"""Measure errors of cameras that are reconstructed from images of synthetic facades.

    python benchmarks/made_scenes.py DATA [--scenes FOLDER]

A scene is a wall with bumps and boxes, textured with photographs of DATA/photos/train. Cameras with
exactly known poses see it from 11 places along an arc of 56 degrees, 8 m away, in images of
1152x768 pixels with noise, varying brightness and JPEG compression. The script runs `deepdetect dev
benchmark sfm` on three scenes with different seeds. It prints the mean errors of camera centres, in
mm, and of rotations, after the alignment of all centres.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

from deepdetect.io.image import find_images
from deepdetect_lab.evaluation.report import Row, Table

SCENES, PLACES, ARC_DEG, DISTANCE_M = 3, 11, 56, 8.0
WALL_M, TILE_PX, PIXELS_PER_M, CELLS_PER_M = (14, 9), 480, 240, 60
WIDTH, HEIGHT, FOCAL_PX, SAMPLING = 1152, 768, 1209.6, 2
NEAREST_M, FARTHEST_M, STEPS, BISECTIONS = -1.5, 1.2, 140, 14
"""Range of depths relative to the plane of the wall, and numbers of steps and of bisections in the
search for the surface along each ray. All numbers of the scene are chosen by hand."""


def make_wall(rng: np.random.Generator, files: list[Path]) -> tuple[np.ndarray, np.ndarray]:
    """Return the colours (H, W, 3) uint8 and the heights (h, w) float32 in metres of a wall."""
    width, height = (side * PIXELS_PER_M for side in WALL_M)
    colours = np.zeros((height, width, 3), np.uint8)
    order = iter(rng.permutation(len(files)))
    for y in range(0, height, TILE_PX):
        for x in range(0, width, TILE_PX):
            tile = cv2.imread(str(files[next(order)]))
            scale = TILE_PX / min(tile.shape[:2])
            how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
            tile = cv2.resize(tile, None, fx=scale, fy=scale, interpolation=how)
            part = colours[y : y + TILE_PX, x : x + TILE_PX]
            part[:] = tile[: part.shape[0], : part.shape[1]]
    heights = np.zeros([side * CELLS_PER_M for side in WALL_M[::-1]], np.float32)
    for size, most in ((3, 0.25), (1, 0.06)):
        noise = rng.normal(size=(WALL_M[1] // size + 3, WALL_M[0] // size + 3)).astype(np.float32)
        bumps = cv2.resize(noise, heights.shape[::-1], interpolation=cv2.INTER_CUBIC)
        heights += most * bumps
    for _ in range(25):
        middle, half = rng.uniform(0, WALL_M), rng.uniform(0.2, 1, 2)
        (left, top), (right, bottom) = (
            (np.maximum(middle + sign * half, 0) * CELLS_PER_M).astype(int) for sign in (-1, 1)
        )
        heights[top:bottom, left:right] += rng.uniform(-0.5, 0.6)
    return colours, cv2.GaussianBlur(heights, (0, 0), 0.8).clip(-FARTHEST_M, -NEAREST_M)


def look(grid: np.ndarray, x: np.ndarray, y: np.ndarray, per_m: int, border: int) -> np.ndarray:
    """Interpolate a grid with `per_m` cells per metre at positions on the wall, in metres."""
    at = [(each * per_m - 0.5).astype(np.float32) for each in (x, y)]
    return cv2.remap(grid, *at, cv2.INTER_LINEAR, borderMode=border)


def photograph(
    wall: tuple[np.ndarray, np.ndarray], matrix: np.ndarray, axes: np.ndarray, centre: np.ndarray
) -> np.ndarray:
    """Render the (H, W, 3) float32 image of a wall by ray casting."""
    colours, heights = wall
    sides = [(np.arange(n * SAMPLING) + 0.5) / SAMPLING - 0.5 for n in (WIDTH, HEIGHT)]
    u, v = np.meshgrid(*sides)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ (np.linalg.inv(matrix).T @ axes)

    def behind(reached: np.ndarray) -> np.ndarray:
        x, y, z = (centre[k] + reached * rays[..., k] for k in range(3))
        return z > -look(heights, x, y, CELLS_PER_M, cv2.BORDER_REPLICATE)

    first, last = ((z - centre[2]) / rays[..., 2] for z in (NEAREST_M, FARTHEST_M))
    far = last.copy()
    found = np.zeros(u.shape, bool)
    for step in range(STEPS + 1):
        reached = first + (last - first) * (step / STEPS)
        new = behind(reached) & ~found
        far[new] = reached[new]
        found |= new
    near = np.maximum(far - (last - first) / STEPS, first)
    for _ in range(BISECTIONS):
        middle = (near + far) / 2
        hit = behind(middle)
        far, near = np.where(hit, middle, far), np.where(hit, near, middle)
    x, y = (centre[k] + far * rays[..., k] for k in range(2))
    seen = look(colours, x, y, PIXELS_PER_M, cv2.BORDER_REFLECT)
    return cv2.resize(seen, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32)


def make_scene(seed: int, files: list[Path], folder: Path) -> None:
    """Write the images and their cameras, in the file format of Strecha's data sets."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([18, seed])
    wall = make_wall(rng, files)
    x, y = ((side - 1) / 2 + rng.uniform(-12, 12) for side in (WIDTH, HEIGHT))
    matrix = np.array([[FOCAL_PX, 0, x], [0, FOCAL_PX, y], [0, 0, 1]])
    middle = np.array([*WALL_M, 0]) / 2
    for number in range(PLACES):
        angle = np.radians(ARC_DEG * (number / (PLACES - 1) - 0.5)) + rng.normal(0, 0.02)
        away = DISTANCE_M + rng.normal(0, 0.5)
        centre = middle + away * np.array([np.sin(angle), 0, -np.cos(angle)])
        centre[1] += rng.normal(0.3, 0.35)
        ahead = middle + rng.normal(0, 0.35, 3) * (1, 1, 0) - centre
        across = np.cross([rng.normal(0, 0.03), 1, 0], ahead)
        axes = np.stack([across, np.cross(ahead, across), ahead])
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        seen = photograph(wall, matrix, axes, centre) / 255
        seen = 255 * seen ** rng.uniform(0.9, 1.1) * rng.uniform(0.85, 1.05)
        seen = np.clip(seen + rng.normal(0, 2.5, seen.shape), 0, 255).astype(np.uint8)
        quality = [cv2.IMWRITE_JPEG_QUALITY, 93]
        cv2.imwrite(str(folder / f"{number:04d}.jpg"), seen, quality)
        rows = [*matrix, (0, 0, 0), *axes.T, centre, (WIDTH, HEIGHT)]
        lines = [" ".join(f"{value:.10g}" for value in row) for row in rows]
        (folder / f"{number:04d}.camera").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Make the scenes, reconstruct them, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--scenes", type=Path, help="folder for the scenes and the report")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.scenes or Path(temporary)
        files = find_images(given.data / "photos/train")
        for seed in range(SCENES):
            make_scene(seed, files, folder / f"made {seed}")
        words = ["-m", "deepdetect", "dev", "benchmark", "sfm", "--data", str(folder)]
        words += ["-o", str(folder / "report"), "--baselines", "sift"]
        subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL)
        report = json.loads((folder / "report" / "report.json").read_text("utf-8"))
    rows: list[Row] = [
        {**row, "centres, mm": 1000 * row["centres, unit of the truth"]}
        for row in report["tables"]["sfm"]["rows"]
    ]
    styles = {"scene": "", "keypoints": "", "intrinsics": "", "centres, mm": ".2f"}
    styles |= {"rotations, °": ".4f", "sparse points": ",d", "track length": ".2f"}
    styles["reprojection error, px"] = ".3f"
    print(Table("made_scenes", "made_scenes", styles, rows).to_markdown())


if __name__ == "__main__":
    main()
