"""Processor time of one photograph and of one pair of a collection, by size.

    python benchmarks/collection_costs.py left.jpg right.jpg

The first table of docs/scale.md: two overlapping photographs are scaled to each size, extracted as
`deepdetect extract` does it and matched as `deepdetect match-many` does it, on one thread. Prints
the fastest of three tries, with the number of keypoints. On a busy machine the same work takes up
to twice the processor time: the load is printed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from deepdetect import DeepDetect, Keypoints, SelectionOptions, load_image
from deepdetect.batch.pair_matching import match_features
from deepdetect.evaluation.report import Cell, Column, Table
from deepdetect.features.sift import described_at_own_size, root_sift_descriptors
from deepdetect.io.image import luma

WIDTHS_PX = (240, 640, 1600, 4000)
BUDGETS = (2048, 8192)
MAX_DENSE_MEGAPIXELS = 2
TRIES = 3


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photographs", type=Path, nargs=2)
    table = cost_table(parser.parse_args().photographs)
    print(f"{table.to_markdown()}\n\n{table.note}")


def cost_table(photographs: list[Path]) -> Table:
    """Extract and match two photographs at several sizes."""
    detector = DeepDetect(threads=1)
    rows: list[tuple[Cell, ...]] = []
    with tempfile.TemporaryDirectory() as folder:
        for width in WIDTHS_PX:
            left, right = (_scaled(path, width, Path(folder)) for path in photographs)
            extracting: list[Cell] = []
            matching: list[Cell] = []
            for budget in BUDGETS:
                extract = partial(_extract, SelectionOptions(max_keypoints=budget), detector)
                seconds, first = _fastest(partial(extract, left))
                extracting += [seconds, len(first)]
                both = [(found.xy, found.descriptors) for found in (first, extract(right))]
                matching.append(_fastest(partial(match_features, *both, scaled=True))[0])
            dense: list[Cell] = [None, None]
            columns, lines = first.image_size
            if columns * lines <= MAX_DENSE_MEGAPIXELS * 1e6:
                extract = partial(_extract, SelectionOptions(mode="dense"), detector)
                seconds, first = _fastest(partial(extract, left))
                dense = [seconds, len(first)]
            rows.append((f"{columns}x{lines}", *extracting, *dense, *matching))
    kinds = (*(f"{budget:,} points" for budget in BUDGETS), "dense")
    titles = (
        Column("photograph, pixels"),
        *(
            column
            for kind in kinds
            for column in (Column(f"{kind}, s", ".2f"), Column(f"{kind}, found", ",d"))
        ),
        *(Column(f"a pair of {budget:,}, s", ".2f") for budget in BUDGETS),
    )
    note = (
        f"Processor seconds of one thread, the fastest of {TRIES} after a first one; load of the "
        f"machine {os.getloadavg()[0]:.1f}."
    )
    return Table("collection_costs", "What a photograph and a pair cost", titles, tuple(rows), note)


def _scaled(path: Path, width: int, folder: Path) -> Path:
    with Image.open(path) as file:
        image = file.convert("RGB")
    height = round(image.height * width / image.width)
    made = folder / f"{path.stem}-{width}.jpg"
    image.resize((width, height), Image.Resampling.LANCZOS).save(made, quality=95)
    return made


def _extract(selection: SelectionOptions, detector: DeepDetect, path: Path) -> Keypoints:
    """Do what `deepdetect extract` does with a photograph."""
    rgb = load_image(path)
    found = detector.detect(rgb, max_keypoints=selection.max_keypoints, mode=selection.mode)
    gray = luma(rgb)
    if found.sizes is not None:
        return described_at_own_size(gray, found)
    root_sift_descriptors(gray, found.xy)
    return found


def _fastest(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the processor time of the fastest try, and what it returned."""
    seconds, found = [], work()  # what is set up once, is
    for _ in range(TRIES):
        start = time.process_time()
        found = work()
        seconds.append(time.process_time() - start)
    return float(np.min(seconds)), found


if __name__ == "__main__":
    main()
