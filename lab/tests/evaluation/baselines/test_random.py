from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from deepdetect_lab.evaluation.baselines.opencv import CLASSICAL
from deepdetect_lab.evaluation.baselines.random import (
    RandomDetector,
    all_pixels_feature,
    random_feature,
)


@pytest.fixture(scope="module")
def crop(photo: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(photo[60:140, 100:200])


def blank(width: int, height: int) -> np.ndarray:
    return np.zeros((height, width, 3), np.uint8)


def test_random_points_are_even_and_follow_the_seed(photo: np.ndarray) -> None:
    points = RandomDetector(3)
    first, second = points.heatmap(photo), points.heatmap(photo)
    assert first.shape == photo.shape[:2]
    assert first.dtype == np.float32
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, RandomDetector(3).heatmap(photo))
    for part in np.array_split(first, 4):
        assert abs((part > 0.5).mean() - 0.5) < 0.02


@pytest.mark.parametrize("name", ["sift", "harris-low"])
def test_random_points_are_as_many_as_those_of_the_method(crop: np.ndarray, name: str) -> None:
    baseline = random_feature(CLASSICAL[name])
    for image in (crop, crop[::-1].copy(), crop[:, ::-1].copy()):
        found = baseline.detect(image)
        assert len(found) == len(CLASSICAL[name].detect(image)) > 0
        # They are distinct pixels of the image.
        assert len(np.unique(found.xy, axis=0)) == len(found)
        assert (found.xy == np.rint(found.xy)).all()
        assert ((found.xy >= 0) & (found.xy < (100, 80))).all()


def test_random_points_are_the_same_again_and_others_in_another_image(crop: np.ndarray) -> None:
    baseline = random_feature(CLASSICAL["harris"])
    first = baseline.detect(crop)
    np.testing.assert_array_equal(first.xy, random_feature(CLASSICAL["harris"]).detect(crop).xy)
    darker = crop.copy()
    darker[0, 0] //= 2  # a pixel is enough
    second = baseline.detect(darker)
    share = len(first) / (100 * 80)
    common = len({tuple(p) for p in first.xy} & {tuple(p) for p in second.xy}) / len(first)
    assert common < share + 0.1


def test_random_points_of_nothing_are_nothing() -> None:
    found = random_feature(CLASSICAL["fast"]).detect(blank(40, 30))
    assert (len(found), found.image_size) == (0, (40, 30))


def test_all_pixels_are_there_once() -> None:
    width, height = 50, 31
    found = all_pixels_feature().detect(blank(width, height))
    assert len(found) == width * height
    assert found.density == 1
    assert len(np.unique(found.xy, axis=0)) == len(found)
    np.testing.assert_array_equal(found.xy.max(0), (width - 1, height - 1))


def test_the_best_of_every_pixel_are_spread_evenly() -> None:
    """No two are nearer than 0.65 of a square grid's step; random points come together."""
    width, height, count = 250, 190, 300
    found = all_pixels_feature().detect(blank(width, height)).best(count)
    assert len(found) == count
    step = np.sqrt(width * height / count)
    nearest = KDTree(found.xy).query(found.xy, 2)[0][:, 1]
    assert nearest.min() > 0.65 * step
    assert nearest.mean() > 0.7 * step  # of random points 0.5
    generator = np.random.default_rng(0)
    chance = generator.permutation(all_pixels_feature().detect(blank(width, height)).xy)[:count]
    assert KDTree(chance).query(chance, 2)[0][:, 1].min() < 0.5 * nearest.min()
    cells = {(int(x) // 32, int(y) // 32) for x, y in found.xy}
    assert len(cells) == 8 * 6, "every 32x32 pixels have a point"
