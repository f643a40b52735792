"""Measure the cost of features, pairs and matches of growing collections on a Ray cluster.

    python benchmarks/scale.py PHOTOGRAPHS [COUNT ...] [--work FOLDER]

Each photograph in PHOTOGRAPHS or its subfolders stands for a place, of which 34 synthetic images
with random perspective and brightness are made. They are small and have few keypoints, so that
100,000 of them take two hours on two cores. Then `extract_features`, the search for similar pairs
and `match_pairs` run on a cluster that this script starts. CPU time is that of all processes,
including Ray's own. Memory is given for the calling process and for its largest child process, a
worker. The script needs the dependency group `ray`.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from deepdetect import PointDetector, load_image
from deepdetect._shared.machine import map_in_processes
from deepdetect._shared.opencv import cv2
from deepdetect.batch import extract_features, match_pairs
from deepdetect.batch.hdf5 import feature_names, open_hdf5
from deepdetect.batch.pair_list import SIMILAR
from deepdetect.batch.similar_pairs import similar_pairs
from deepdetect_lab.evaluation.profiling import peak_memory, run_in_child
from deepdetect_lab.evaluation.report import Table

COUNTS = (1000, 10_000, 100_000)
VIEWS = 34
"""Number of images of one place, which must exceed the number of similar images to match with."""

SIZE = (320, 240)
POINTS = 256
SHRUNK, SHIFTED = 0.8, 0.1
"""The longer side of a view's frame is the fraction `SHRUNK` of the photograph's shorter side. Each
corner moves in x and y by up to the fraction `SHIFTED` of that longer side. Chosen by hand."""

COLUMNS = {
    "images": ",d",
    "features, CPU s an image": ".4f",
    "similar pairs, CPU s an image": ".4f",
    "pairs": ",d",
    "of one place": ".3f",
    "matching, CPU s a pair": ".4f",
    **{f"{stage}, MB": ",.0f" for stage in ("features", "similar pairs", "matching")},
    "a worker, MB": ",.0f",
    "files, MB": ",.0f",
}


def make_images(task: tuple[Path, Path, int]) -> None:
    """Write a number of views of a photograph to a folder."""
    photograph, folder, count = task
    rng = np.random.default_rng(int(folder.name))
    image = load_image(photograph)[..., ::-1]
    height, width = image.shape[:2]
    frame = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * SIZE
    frame = frame / max(SIZE) * SHRUNK * min(width, height)
    folder.mkdir(parents=True)
    for k in range(count):
        corners = frame + rng.uniform(0, np.array([width, height]) - frame.max(axis=0))
        corners += rng.uniform(-SHIFTED, SHIFTED, (4, 2)) * frame.max()
        to = np.array([(0, 0), (SIZE[0], 0), SIZE, (0, SIZE[1])], np.float32)
        seen = cv2.getPerspectiveTransform(corners.astype(np.float32), to)
        view = cv2.warpPerspective(image, seen, SIZE, borderMode=cv2.BORDER_REFLECT)
        view = cv2.convertScaleAbs(view, alpha=rng.uniform(0.6, 1.2))
        cv2.imwrite(str(folder / f"{k:02}.jpg"), view)


class Watch(threading.Thread):
    """A thread that measures CPU seconds of all processes and the memory of the largest child."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.seconds: dict[int, float] = {}
        self.worker_bytes = 0
        self.ended = threading.Event()

    def run(self) -> None:
        """Sample all processes until `ended` is set."""
        own = psutil.Process()
        while True:
            over = self.ended.wait(0.5)
            for process in (own, *own.children(recursive=True)):
                try:
                    used, memory = process.cpu_times(), process.memory_info().rss
                except psutil.Error:
                    continue
                self.seconds[process.pid] = used.user + used.system
                if process is not own:
                    self.worker_bytes = max(self.worker_bytes, memory)
            if over:
                return


def watched(work: Callable[..., Any], *arguments: Any) -> dict[str, Any]:
    """Run a function, and measure its CPU seconds and memory. Call it in a separate process."""
    watch, before = Watch(), time.process_time()
    watch.start()
    found = work(*arguments)
    watch.ended.set()
    watch.join()
    return {
        "found": found,
        "CPU s": sum(watch.seconds.values()) - before,
        "own bytes": peak_memory(),
        "worker bytes": watch.worker_bytes,
    }


def find_features(folder: Path, path: Path) -> None:
    """Extract the features of all images below a folder."""
    extract_features(folder, path, PointDetector(POINTS), engine="ray", quiet=False).check()


def find_pairs(path: Path) -> list[tuple[str, str]]:
    """Return the pairs of similar images."""
    with open_hdf5(path) as file:
        names = sorted(feature_names(file))
    return similar_pairs(path, names, SIMILAR, quiet=False)[0]


def find_matches(features: Path, pairs: list[tuple[str, str]], path: Path) -> None:
    """Match pairs of images."""
    match_pairs(features, pairs, path, engine="ray", quiet=False).check()


def measure(photographs: list[Path], count: int, work: Path) -> dict[str, Any]:
    """Make `count` images, process them, and return the row of the table."""
    tasks = [
        (photographs[k], work / "images" / f"{k:05}", min(VIEWS, count - VIEWS * k))
        for k in range(-(-count // VIEWS))
    ]
    for _ in map_in_processes(make_images, tasks):
        pass
    features, matches = work / "features.h5", work / "matches.h5"
    first = run_in_child(watched, find_features, work / "images", features)
    chosen = run_in_child(watched, find_pairs, features)
    pairs = chosen.pop("found")
    last = run_in_child(watched, find_matches, features, pairs, matches)
    stages = {"features": first, "similar pairs": chosen, "matching": last}
    return {
        "images": count,
        "pairs": len(pairs),
        "features, CPU s an image": first["CPU s"] / count,
        "similar pairs, CPU s an image": chosen["CPU s"] / count,
        "of one place": np.mean([Path(a).parent == Path(b).parent for a, b in pairs]),
        "matching, CPU s a pair": last["CPU s"] / len(pairs),
        **{f"{name}, MB": stage["own bytes"] / 1e6 for name, stage in stages.items()},
        "a worker, MB": max(first["worker bytes"], last["worker bytes"]) / 1e6,
        "files, MB": sum(path.stat().st_size for path in (features, matches)) / 1e6,
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("counts", type=int, nargs="*", default=COUNTS)
    parser.add_argument("--work", type=Path, help="folder with enough space for the files")
    arguments = parser.parse_args()
    photographs = sorted(arguments.photographs.rglob("*.jpg"))
    if len(photographs) * VIEWS < max(arguments.counts):
        raise SystemExit(f"{max(arguments.counts) // VIEWS + 1} photographs are needed")
    os.environ["RAY_ADDRESS"] = "local"  # processes of another cluster could not be measured
    rows = []
    if arguments.work is not None:
        arguments.work.mkdir(parents=True, exist_ok=True)
    for count in arguments.counts:
        work = Path(tempfile.mkdtemp(dir=arguments.work))
        try:
            rows.append(measure(photographs, count, work))
        finally:
            shutil.rmtree(work)
        print(rows[-1], flush=True)
    print(Table("scale", "", COLUMNS, rows).to_markdown())


if __name__ == "__main__":
    main()
