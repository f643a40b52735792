"""Rates of `deepdetect extract`: one process, all processes, Ray; in turn, ratios of each round.

    python benchmarks/collection_rates.py photos/ --images 2000 --rounds 3

Cuts the wanted number of squares out of the photographs below a folder into a temporary one. Ray is
left out where it is not installed. Prints seconds, photographs per second, and for each round the
ratio to one process, and of Ray to processes. On a machine that does other work the ratios say
little: its load is printed with them.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image

from deepdetect import load_image
from deepdetect._shared.parallel import processor_count
from deepdetect.io.image import find_images


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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--side", type=int, default=240, help="of the squares, in pixels")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
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
