"""Guided matching of real pairs, judged by the refined homographies of Oxford."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetect, HeatmapOptions, match_images
from deepdetect.datasets.oxford import find_scene, load_oxford
from deepdetect.geometry import transform_points
from deepdetect.guidance.by_homography import nearest_pixel
from deepdetect.image import load_image
from deepdetect.metrics.homography_accuracy import corner_error

BARS = {
    ("graf", 6): (0.80, 0.95),
    ("leuven", 6): (0.88, 0.95),
    ("ubc", 6): (0.90, 0.93),
    ("boat", 6): (0.80, 0.97),
    ("bark", 6): (0.85, 0.97),
}
"""Share of the ceiling, and precision; all nine pairs by benchmarks/guided_matching.py."""


@pytest.mark.parametrize(("scene", "number"), BARS)
def test_most_of_what_can_be_matched_is(shared: Path, scene: str, number: int) -> None:
    scenes = load_oxford(shared / "data" / "oxford", "refined")
    pair = list(find_scene(scenes, scene).pairs())[number - 2]
    rgb = [load_image(image) for image in (pair.first, pair.second)]
    found = match_images(*rgb, DeepDetect().configured(HeatmapOptions(480)))
    assert found.guided
    places = transform_points(found.keypoints0.xy, pair.homography)
    size = (rgb[1].shape[1], rgb[1].shape[0])
    ceiling = np.count_nonzero(nearest_pixel(places, found.keypoints1.xy, size)[1] < 1)
    errors = np.linalg.norm(
        transform_points(found.points0, pair.homography) - found.points1, axis=1
    )
    share, precision = BARS[scene, number]
    assert np.count_nonzero(errors < 1) >= share * ceiling
    assert (errors < 1).mean() >= precision
    assert corner_error(found.model, pair.homography, rgb[0].shape[1::-1]) <= 1.5
