"""Guided matching of real pairs, evaluated by the refined homographies of Oxford."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import DeepDetect, match_images
from deepdetect.datasets.oxford import load_oxford
from deepdetect.detector import HeatmapOptions
from deepdetect.evaluation.metrics.homography import corner_error
from deepdetect.features.keypoints import nearest_keypoints
from deepdetect.geometry import transform_points
from deepdetect.io.image import load_image

pytestmark = pytest.mark.slow

BARS = {
    ("graf", 6): (0.80, 0.95),
    ("leuven", 6): (0.88, 0.95),
    ("ubc", 6): (0.90, 0.93),
    ("boat", 6): (0.80, 0.97),
    ("bark", 6): (0.85, 0.97),
}
"""Share of the ceiling, and precision; of all nine: `deepdetect benchmark --protocol guided`."""


@pytest.mark.parametrize(("scene", "number"), BARS)
def test_most_of_what_can_be_matched_is(shared: Path, scene: str, number: int) -> None:
    scenes = load_oxford(shared / "data" / "oxford", "refined")
    pair = list(next(one for one in scenes if one.name == scene).pairs())[number - 2]
    rgb = [load_image(image) for image in (pair.first, pair.second)]
    found = match_images(*rgb, DeepDetect().configured(HeatmapOptions(480)))
    assert found.guided
    places = transform_points(found.keypoints0.xy, pair.homography)
    size = (rgb[1].shape[1], rgb[1].shape[0])
    ceiling = np.count_nonzero(nearest_keypoints(places, found.keypoints1.xy, size)[1] < 1)
    errors = np.linalg.norm(
        transform_points(found.points0, pair.homography) - found.points1, axis=1
    )
    share, precision = BARS[scene, number]
    assert np.count_nonzero(errors < 1) >= share * ceiling
    assert (errors < 1).mean() >= precision
    assert corner_error(found.matrix, pair.homography, rgb[0].shape[1::-1]) <= 1.5


@pytest.mark.parametrize(("scene", "photograph"), [("ubc", "chelsea"), ("leuven", "astronaut")])
def test_hardly_anything_is_matched_under_a_strange_photograph(
    shared: Path, scene: str, photograph: str
) -> None:
    """It covers a quarter of the second image, its middle; the bar is 2 %."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    pair = list(
        next(one for one in load_oxford(shared / "data" / "oxford") if one.name == scene).pairs()
    )[4]
    first, second = (load_image(image) for image in (pair.first, pair.second))
    height, width = second.shape[0] // 2, second.shape[1] // 2
    top, left = height // 2, width // 2
    strange = cv2.resize(getattr(data, photograph)(), (width, height), interpolation=cv2.INTER_AREA)
    second = second.copy()
    second[top : top + height, left : left + width] = strange
    found = match_images(first, second, DeepDetect().configured(HeatmapOptions(480)))
    assert found.guided

    def under(points: np.ndarray) -> int:
        x, y = (transform_points(points, pair.homography) + 0.5).T
        inside = (x > left) & (x < left + width) & (y > top) & (y < top + height)
        return int(np.count_nonzero(inside))

    assert under(found.keypoints0.xy) > 10_000
    assert under(found.points0) < 0.02 * under(found.keypoints0.xy)
