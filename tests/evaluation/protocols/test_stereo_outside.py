"""Pairs with an offset of their disparity, and the points that their right image cannot show."""

from __future__ import annotations

import numpy as np
import pytest

from deepdetect.datasets.types import CalibratedStereoPair
from deepdetect.evaluation.protocols.stereo_outside import (
    CROPPED_PX,
    crop_pair,
    crop_truth,
    outside_table,
)
from deepdetect.evaluation.protocols.stereo_pipelines import StereoPoints, sgbm
from deepdetect.geometry.camera import Calibration, Camera

WIDTH, HEIGHT, SHIFT = 200, 60, 9


@pytest.fixture(scope="module")
def pair(rectified_colours) -> CalibratedStereoPair:
    left, right = rectified_colours
    camera = Camera((WIDTH, HEIGHT), 100.0, (90.0, 30.0))
    truth = np.full((HEIGHT, WIDTH), SHIFT, np.float32)
    return CalibratedStereoPair("x", left, right, truth, Calibration(camera, camera, 50))


@pytest.fixture(scope="module")
def rectified_colours() -> tuple[np.ndarray, np.ndarray]:
    import cv2

    texture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH + SHIFT, 3), np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 1)
    return texture[:, :WIDTH].copy(), texture[:, SHIFT:].copy()


@pytest.mark.parametrize("offset", [-40, 0, 7])
def test_a_cropped_pair_shows_the_same_places(pair: CalibratedStereoPair, offset: int) -> None:
    found = crop_pair(pair, offset)
    width = WIDTH - abs(offset)
    assert found.left.shape == found.right.shape == (HEIGHT, width, 3)
    np.testing.assert_array_equal(found.disparity, np.full((HEIGHT, width), SHIFT + offset))
    np.testing.assert_array_equal(found.disparity, crop_truth(pair.disparity, offset))
    column = np.arange(width)
    seen = (column >= SHIFT + offset) & (column - SHIFT - offset < width)
    there = column[seen] - SHIFT - offset
    np.testing.assert_array_equal(found.left[:, seen], found.right[:, there])


@pytest.mark.parametrize("offset", [-40, 7])
def test_a_cropped_pair_has_the_same_depths(pair: CalibratedStereoPair, offset: int) -> None:
    found = crop_pair(pair, offset)
    calibration = found.calibration
    assert calibration.disparity_offset_px == -offset
    assert calibration.camera0.size == calibration.camera1.size == (WIDTH - abs(offset), HEIGHT)
    for one, other in ((pair, pair.calibration), (found, calibration)):
        np.testing.assert_allclose(other.depth_mm(one.disparity), 100 * 50 / SHIFT)
    kept = np.array([[max(-offset, 0) + 20.0, 30.0]])
    cropped = kept - [max(-offset, 0), 0]
    np.testing.assert_allclose(
        calibration.camera0.rays(cropped), pair.calibration.camera0.rays(kept)
    )


@pytest.mark.parametrize("offset", [-60, 0, 60])
def test_sgbm_finds_disparities_of_both_signs(pair: CalibratedStereoPair, offset: int) -> None:
    found = sgbm(crop_pair(pair, offset))
    assert (np.abs(found.disparity - SHIFT - offset) < 0.5).mean() > 0.85
    inside = WIDTH - abs(offset) - abs(SHIFT + offset)
    assert len(found.pixels) > 0.9 * HEIGHT * inside


def test_the_table_counts_what_is_given_and_what_is_right() -> None:
    truth = np.full((1, 200), 3.0)
    pixels = np.array([[0, 0], [2, 0], [50, 0]])
    points = {
        ("a", 0): StereoPoints(pixels, np.array([3.4, 9.0, 3.0]), 0, {}, 0),
        ("a", CROPPED_PX[1]): StereoPoints(pixels, np.array([43.0, 43.5, 0]), 0, {}, 0),
    }
    table = outside_table("x", "title", truth, points, ["a"])
    assert table.key == "middlebury_outside_x"
    rows = {row[1]: row for row in table.rows}
    assert rows[0][2:5] == (3, 2, 0.5)
    assert rows[CROPPED_PX[1]][2:5] == (43, 2, 1.0)
    assert rows[CROPPED_PX[0]][2:] == (None,) * 5
    assert rows[0][5] == pytest.approx(2 / 3)
    assert rows[0][6] == pytest.approx(2 / 200)
