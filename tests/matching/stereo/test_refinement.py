from __future__ import annotations

import numpy as np
import pytest

from deepdetect.matching.stereo.refinement import refine_disparity

SHAPE = (60, 120)
ROW, COLUMN = np.indices(SHAPE)
INNER = np.s_[4:-4, 30:-4]


@pytest.mark.parametrize("off", [-0.4, 0.0, 0.3])
def test_it_finds_what_is_left_from_nearby(off: float, rectified_pair) -> None:
    truth = (9.3 + 0.05 * COLUMN - 0.04 * ROW).astype(np.float32)
    left, right = rectified_pair(truth)
    known = np.ones(SHAPE, bool)
    refined = refine_disparity(left, right, truth + np.float32(off), known)
    errors = np.abs(refined - truth)[INNER]
    assert np.median(errors) < 0.02
    assert np.quantile(errors, 0.99) < 0.1


def test_gain_and_offset_do_not_matter(rectified_pair) -> None:
    truth = np.full(SHAPE, 6.4, np.float32)
    left, right = rectified_pair(truth)
    dimmed = np.rint(right * 0.6 + 30).astype(np.uint8)
    refined = refine_disparity(left, dimmed, np.full(SHAPE, 6.0, np.float32), truth > 0)
    assert np.median(np.abs(refined - truth)[INNER]) < 0.02


def test_a_flat_image_keeps_a_plane_as_it_is() -> None:
    plane = (5 + 0.1 * COLUMN).astype(np.float32)
    flat = np.full(SHAPE, 100, np.uint8)
    refined = refine_disparity(flat, flat, plane, np.ones(SHAPE, bool))
    np.testing.assert_allclose(refined, plane, atol=1e-4)


def test_another_surface_does_not_count(rectified_pair) -> None:
    truth = np.where(COLUMN < 70, 4.3, 9.0).astype(np.float32)
    left, right = rectified_pair(truth)
    alone = refine_disparity(left, right, truth, COLUMN < 70)
    both = refine_disparity(left, right, truth, np.ones(SHAPE, bool))
    np.testing.assert_array_equal(alone[:, :70], both[:, :70])


def test_unknown_pixels_stay_and_do_not_count(rectified_pair) -> None:
    truth = np.full(SHAPE, 6.4, np.float32)
    left, right = rectified_pair(truth)
    known = np.random.default_rng(0).random(SHAPE) < 0.7
    start = np.where(known, truth, np.float32(77))
    refined = refine_disparity(left, right, start, known)
    assert (refined[~known] == 77).all()
    assert np.median(np.abs(refined - truth)[known]) < 0.02
