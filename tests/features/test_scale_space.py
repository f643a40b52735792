"""The scale space beside that of OpenCV's SIFT, and Gaussian blur of the whole image."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.features.keypoints import Keypoints
from deepdetect.features.scale_space import gaussian_layers, nearest_layers
from deepdetect.io.image import luma


def test_the_layer_of_a_size_is_the_one_in_which_sift_detects_it(photo: np.ndarray) -> None:
    gray = luma(photo)
    found = cv2.SIFT_create(contrastThreshold=0.01).detect(gray, None)
    points = Keypoints.from_opencv(found, gray.shape[::-1])
    assert points.octaves is not None
    assert points.sizes is not None
    octaves, layers = nearest_layers(points.sizes, gray.shape)
    assert len(set(octaves.tolist())) >= 3
    np.testing.assert_array_equal(octaves & 255, points.octaves & 255)
    np.testing.assert_array_equal(layers, points.octaves >> 8 & 255)


@pytest.mark.parametrize("shape", [(3, 5), (20, 30), (400, 500)])
def test_sizes_beyond_the_image_get_its_last_octave(shape: tuple[int, int]) -> None:
    octaves, layers = nearest_layers(np.array([0.0, 0.1, 1e6]), shape)
    assert octaves[:2].tolist() == [-1, -1]
    assert 0 <= octaves[2] <= max(0, np.log2(min(shape) / 8))
    assert set(layers.tolist()) <= {1, 2, 3}


def test_layers_are_the_blurred_image_at_their_scale() -> None:
    rng = np.random.default_rng(0)
    gray = cv2.GaussianBlur(rng.uniform(0, 255, (96, 128)).astype(np.float32), (0, 0), 2)
    before = 0.5
    for octave, layer, image in gaussian_layers(gray, -1, 2):
        sigma = 1.6 * 2 ** (octave + layer / 3)
        whole = cv2.GaussianBlur(gray, (0, 0), (sigma**2 - before**2) ** 0.5)
        step = 2.0**octave
        inner = [
            (row, column)
            for row in range(12, image.shape[0] - 12, 5)
            for column in range(12, image.shape[1] - 12, 5)
            if row * step % 1 == column * step % 1 == 0
        ]
        for row, column in inner:
            expected = whole[int(row * step), int(column * step)]
            assert image[row, column] == pytest.approx(expected, abs=3)
