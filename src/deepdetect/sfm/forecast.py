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
from ..batch.pair_list import following, list_pairs, similar
from ..detector.heatmap import MAX_AUTO_PIXELS
from .depth_maps import MAX_SIDE_PX
from .stages import MultiViewOptions, Stages, check_images

MIN_IMAGES, MEASURED = 30, 3
"""Least images of which it is told, and how many of them are extracted and matched to tell it."""

UNIQUE_SHARE = 0.6
"""Pairs an image, of those with its most similar ones: often each is among those of the other."""

MEGAPIXEL_S, KEYPOINT_S = 0.14, 9.5e-6
MAPPED_IMAGE_S, PAIRED_KEYPOINT_S, DENSE_MEGAPIXEL_S = 0.75, 2.5e-6, 3.1
"""Seconds on one machine, of features, and of mapping and dense points: what the first take on
this machine tells what the others will. Mapping differs by a factor of two among scenes."""

ADJUSTED_IMAGES = 250
"""The more images are mapped already, the longer an adjustment takes: with so many, the mapping of
an image takes twice as long as the first."""


def expected_seconds(stages: Stages, folder: Path, *how: Any) -> dict[str, float]:
    """Extract and match a few images below a folder, and return what each stage will take of all.

    `how` is as of `Stages.extract`. It is empty for few images, and where an earlier run has begun.
    """
    names, options = [*check_images(folder)], stages.options
    count, workers = len(names), min(stages.workers or processor_count(), len(names))
    if count < MIN_IMAGES or any(stages.work.glob(f"{stages.features.name}*")):
        return {}
    few = [folder / names[k * count // MEASURED] for k in range(MEASURED)]
    measured = [*map_in_processes(_measure, [(few, options, how)] * workers, workers)]
    image_s, pair_s, megapixels, keypoints = map(float, np.mean(measured, axis=0))
    if not pair_s:
        return {}
    choice = options.pair_choice(count)
    partners = following(choice) or UNIQUE_SHARE * (similar(choice) or 0)
    pairs = count * min(partners, (count - 1) / 2)
    scaled = min(megapixels, MAX_AUTO_PIXELS / 1e6)
    pace = image_s / (scaled * MEGAPIXEL_S + keypoints * KEYPOINT_S)
    mapped = count * (1 + count / ADJUSTED_IMAGES) * MAPPED_IMAGE_S
    return {
        "features": count * image_s / workers,
        "matching": pairs * pair_s / workers,
        "mapping": pace * (mapped + pairs * keypoints * PAIRED_KEYPOINT_S),
        "dense points": pace * options.dense * count * megapixels * DENSE_MEGAPIXEL_S / workers,
    }


def _measure(task: tuple[Sequence[Path], MultiViewOptions, Sequence[Any]]) -> tuple[float, ...]:
    """Return the seconds of an image and of a pair, and megapixels and keypoints of an image."""
    images, options, how = task
    with tempfile.TemporaryDirectory(prefix="deepdetect-") as scratch:
        try:
            for attempt in "12":  # the first also loads what both need
                stages = Stages(Path(scratch, attempt), options, 1, True)
                start = time.perf_counter()
                sizes, keypoints, _ = stages.extract(stages.folder_of(images), *how)
                image_s = (time.perf_counter() - start) / len(images)
            pairs = list_pairs("exhaustive", [*sizes])
            start = time.perf_counter()
            stages.match(pairs)
            pair_s = (time.perf_counter() - start) / len(pairs)
        except (DeepDetectError, ZeroDivisionError):  # too few can be read
            return 0, 0, 0, 0
    areas = [math.prod(size) * min(1, MAX_SIDE_PX / max(size)) ** 2 for size in sizes.values()]
    return image_s, pair_s, float(np.mean(areas)) / 1e6, float(np.mean([*keypoints.values()]))
