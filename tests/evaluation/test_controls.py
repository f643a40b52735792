from __future__ import annotations

import numpy as np

from deepdetect import match_images
from deepdetect.evaluation.controls import EveryPixel, RandomPoints


def test_random_points_are_even_and_follow_the_seed(photo: np.ndarray) -> None:
    points = RandomPoints(3)
    first, second = points.heatmap(photo), points.heatmap(photo)
    assert first.shape == photo.shape[:2]
    assert first.dtype == np.float32
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(first, RandomPoints(3).heatmap(photo))
    for part in np.array_split(first, 4):
        assert abs((part > 0.5).mean() - 0.5) < 0.02


def test_every_pixel_is_a_keypoint(photo: np.ndarray) -> None:
    small = photo[:40, :50]
    found = match_images(small, small, EveryPixel(), model="none")
    assert len(found.keypoints0) == small.shape[0] * small.shape[1]
