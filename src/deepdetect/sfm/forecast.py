"""How long a reconstruction will take, before it starts."""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import DeepDetectError
from .._shared.machine import map_in_processes, processor_count
from ..batch.pair_list import following, list_pairs
from ..detector.detector import DeepDetect
from ..detector.heatmap import MAX_AUTO_PIXELS
from ..detector.point_detector import PointDetector
from ..features.selection import SelectionOptions
from ..io.image_file import ReadingOptions, read_with, reading_options
from .dense import MAX_SIDE_PX
from .pair_selection import SIMILAR
from .stages import MultiViewOptions, Stages, check_images

MIN_IMAGES, MEASURED = 10, 3
"""Least images of which it is told, and how many of them are extracted and matched to tell it."""

UNIQUE_SHARE = 0.7
"""Pairs over `SIMILAR` an image: often both are among the most similar images of the other."""

MEGAPIXEL_S, KEYPOINT_S = 0.22, 2e-5
"""CPU seconds of features where the following were measured."""

MAPPED_IMAGE_S, MAPPED_PAIR_S, DENSE_MEGAPIXEL_S = 2.2, 0.15, 2.5
"""CPU seconds of mapping and of dense points. Mapping differs by a factor of two among scenes."""


def expected_seconds(
    stages: Stages,
    folder: Path,
    detector: DeepDetect | PointDetector,
    selection: SelectionOptions | None = None,
) -> dict[str, float]:
    """Extract and match a few images below a folder, and return what each stage will take of all.

    It is empty for few images, and where an earlier run has begun.
    """
    names, options = [*check_images(folder)], stages.options
    count = len(names)
    if count < MIN_IMAGES or any(stages.work.glob(f"{stages.features.name}*")):
        return {}
    few = [folder / names[k * count // MEASURED] for k in range(MEASURED)]
    workers = min(stages.workers or processor_count(), count)
    task = few, detector, selection, options, reading_options()
    measured = [*map_in_processes(_measure, [task] * workers, workers)]
    image_s, pair_s, megapixels, keypoints = map(float, np.mean(measured, axis=0))
    if not pair_s:
        return {}
    partners = following(options.pair_choice(count)) or UNIQUE_SHARE * SIMILAR
    pairs = count * min(partners, (count - 1) / 2)
    scaled = min(megapixels, MAX_AUTO_PIXELS / 1e6)
    pace = image_s / (scaled * MEGAPIXEL_S + keypoints * KEYPOINT_S)
    return {
        "features": count * image_s / workers,
        "matching": pairs * pair_s / workers,
        "mapping": pace * (count * MAPPED_IMAGE_S + pairs * MAPPED_PAIR_S),
        "dense points": pace * options.dense * count * megapixels * DENSE_MEGAPIXEL_S / workers,
    }


def _measure(task: tuple[Sequence[Path], Any, Any, MultiViewOptions, ReadingOptions]) -> Any:
    """Return the seconds of an image and of a pair, and megapixels and keypoints of an image."""
    images, detector, selection, options, reading = task
    with read_with(reading), tempfile.TemporaryDirectory(prefix="deepdetect-") as scratch:
        try:
            for attempt in "12":  # the first also loads what both need
                stages = Stages(Path(scratch, attempt), options, 1, True)
                folder = stages.folder_of(images)
                start = time.perf_counter()
                sizes, keypoints, _ = stages.extract(folder, detector, selection)
                extracted = time.perf_counter()
            pairs = list_pairs("exhaustive", [*sizes])
            stages.match(pairs)
            pair_s = (time.perf_counter() - extracted) / len(pairs)
        except (DeepDetectError, ZeroDivisionError):  # too few can be read
            return 0, 0, 0, 0
    areas = [math.prod(size) * min(1, MAX_SIDE_PX / max(size)) ** 2 for size in sizes.values()]
    image_s = (extracted - start) / len(sizes)
    return image_s, pair_s, np.mean(areas) / 1e6, np.mean([*keypoints.values()])
