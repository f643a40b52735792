"""Rates of `deepdetect extract`: one process, all processes, Ray; in turn, ratios of each round.

    python benchmarks/collection_rates.py photos/ --images 2000 --rounds 3
    python benchmarks/collection_rates.py photos/ --costs 240 640 1600 4000 --rounds 3

The first line cuts the wanted number of squares out of the photographs below a folder into a
temporary one. Ray is left out where it is not installed. Prints seconds, photographs per second,
and for each round the ratio to one process, and of Ray to processes. On a machine that does other
work the ratios say little: its load is printed with them.

The second line prints the CPU seconds of one thread for a photograph and for a pair whose longer
sides have so many pixels: the first two photographs of the folder, scaled. The fastest round
counts; in brackets are the keypoints found, where that is not the number asked for.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from PIL import Image

from deepdetect import DeepDetect, Keypoints, load_image
from deepdetect._shared.parallel import processor_count, use_one_thread
from deepdetect.batch.pair_matching import match_features
from deepdetect.evaluation.report import Cell, Column, Table
from deepdetect.features.sift import described_at_own_size, root_sift_descriptors
from deepdetect.io.image import find_images, luma

BUDGETS = (2048, 8192)
"""Points of a photograph."""

MAX_DENSE_PIXELS = 2_000_000
"""Of photographs whose dense keypoints are described, too."""

Outcome = TypeVar("Outcome")


def cut_squares(source: Path, target: Path, count: int, side_px: int) -> None:
    """Write squares of photographs, each at another place."""
    photographs = find_images(source)
    for k in range(count):
        rgb = load_image(photographs[k % len(photographs)])
        y, x = (37 * k % max(1, length - side_px + 1) for length in rgb.shape[:2])
        Image.fromarray(rgb[y : y + side_px, x : x + side_px]).save(target / f"{k:06d}.jpg")


def run(photographs: Path, output: Path, arguments: list[str]) -> float:
    """Extract into a new file; return the seconds from start to end."""
    output.unlink(missing_ok=True)
    command = [sys.executable, "-m", "deepdetect", "extract", photographs, "-o", output]
    start = time.perf_counter()
    subprocess.run([*command, *arguments], check=True, capture_output=True)
    return time.perf_counter() - start


def cost_table(pair: Sequence[np.ndarray], sides_px: Sequence[int], rounds: int) -> Table:
    """Measure the first photograph of a pair, and the matching of both, at several sizes."""
    use_one_thread()
    detector = DeepDetect(threads=1)
    rows = []
    for side in sides_px:
        views = [scaled(rgb, side) for rgb in pair]
        height, width = views[0].shape[:2]
        extracted, matched = [], []
        for budget in BUDGETS:
            seconds, found = fastest(partial(describe, detector, views[0], budget), rounds)
            few = f" ({len(found):,})" if len(found) < budget else ""
            extracted.append(f"{seconds:.2f}{few}")
            other = describe(detector, views[1], budget)
            both = [(points.xy, points.descriptors) for points in (found, other)]
            matched.append(fastest(partial(match_features, *both, scaled=True), rounds)[0])
        dense: Cell = None
        if height * width <= MAX_DENSE_PIXELS:
            seconds, found = fastest(partial(describe, detector, views[0], None), rounds)
            dense = f"{seconds:.2f} ({len(found):,})"
        rows.append((f"{width}x{height}", *extracted, dense, *matched))
    columns = (
        Column("photograph, pixels"),
        *(Column(f"{budget:,} points") for budget in BUDGETS),
        Column("dense"),
        *(Column(f"a pair of {budget:,}", ".3f") for budget in BUDGETS),
    )
    return Table("costs", "CPU seconds", columns, tuple(rows))


def scaled(rgb: np.ndarray, side_px: int) -> np.ndarray:
    """Scale a photograph to a longer side."""
    height, width = rgb.shape[:2]
    size = tuple(max(1, round(length * side_px / max(height, width))) for length in (width, height))
    return np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.LANCZOS))


def describe(detector: DeepDetect, rgb: np.ndarray, budget: int | None) -> Keypoints:
    """Find and describe points, or dense keypoints, as `deepdetect extract` does."""
    if budget is not None:
        return described_at_own_size(luma(rgb), detector.detect(rgb, max_keypoints=budget))
    found = detector.detect(rgb)
    return replace(found, descriptors=root_sift_descriptors(luma(rgb), found.xy))


def fastest(work: Callable[[], Outcome], rounds: int) -> tuple[float, Outcome]:
    """Return the least CPU seconds of some rounds after a first one, and what the work returned."""
    found = work()  # compiles kernels
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return min(seconds), found


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--side", type=int, default=240, help="of the squares, in pixels")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--costs", type=int, nargs="+", metavar="PIXELS", help="print CPU seconds")
    arguments = parser.parse_args()
    if arguments.costs:
        pair = [load_image(path) for path in find_images(arguments.photographs)[:2]]
        print(cost_table(pair, arguments.costs, arguments.rounds).to_markdown())
        return
    count = processor_count()
    ways = {
        "one process": ["--workers", "1"],
        f"{count} processes": ["--workers", str(count)],
    }
    if importlib.util.find_spec("ray") is not None:
        ways[f"Ray, {count} workers"] = ["--engine", "ray", "--workers", str(count)]
    with tempfile.TemporaryDirectory() as folder:
        photographs = Path(folder, "photographs")
        photographs.mkdir()
        cut_squares(arguments.photographs, photographs, arguments.images, arguments.side)
        os.environ["OMP_NUM_THREADS"] = "1"
        os.environ["RAY_ADDRESS"] = "local"
        run(photographs, Path(folder, "warm.h5"), ["--max-keypoints", "9"])  # compiles kernels
        print("| way | seconds | images/s | times one process | times processes | load |")
        print("|---|--:|--:|--:|--:|--:|")
        for _ in range(arguments.rounds):
            seconds: list[float] = []
            for name, options in ways.items():
                seconds.append(run(photographs, Path(folder, "features.h5"), options))
                rate = arguments.images / seconds[-1]
                faster = f"{seconds[0] / seconds[-1]:.2f}"
                slower = f"{seconds[-1] / seconds[1]:.2f}" if len(seconds) > 1 else ""
                load = f"{os.getloadavg()[0]:.1f}"
                print(
                    f"| {name} | {seconds[-1]:.1f} | {rate:.1f} | {faster} | {slower} | {load} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
