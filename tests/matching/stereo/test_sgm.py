"""Census and whole disparities, compared with their definitions and with OpenCV."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect.matching.stereo import sgm as module
from deepdetect.matching.stereo.sgm import (
    census,
    is_textured,
    match_distance,
    matching_cost,
    refine_disparity,
    semi_global_matching,
)


@pytest.fixture(scope="module")
def motorcycle() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    pytest.importorskip("skimage", reason="needs scikit-image for its stereo pair")
    from deepdetect_lab.datasets.middlebury import load_motorcycle

    pair = load_motorcycle()
    part = slice(150, 310)
    left, right = (
        cv2.cvtColor(np.ascontiguousarray(view[part]), cv2.COLOR_RGB2GRAY)
        for view in (pair.left, pair.right)
    )
    return left, right, pair.disparity[part]


def test_flat_windows_have_no_texture() -> None:
    gray = np.full((20, 40), 250, np.uint8)
    gray[5, 35] = 200
    found = is_textured(gray)
    assert found[2:9, 31:40].all()
    assert found.sum() == 63


def test_it_is_at_least_as_right_as_opencv(motorcycle) -> None:
    left, right, truth = motorcycle
    found = semi_global_matching(left, right, (0, 63))
    other = cv2.StereoSGBM_create(
        0, 64, 5, 600, 2400, uniquenessRatio=10, speckleWindowSize=100, speckleRange=2
    )
    theirs = other.compute(left, right) / 16
    shares = [
        np.mean(np.abs(disparity - truth)[known & np.isfinite(truth)] <= 1)
        for disparity, known in ((found.disparity, found.consistent), (theirs, theirs >= 0))
    ]
    assert shares[0] > shares[1] - 0.01
    assert found.consistent.mean() > 0.75
    both = found.consistent & (theirs >= 0)
    assert np.median(np.abs(found.disparity - theirs)[both]) < 0.2


def test_bands_give_nearly_what_the_whole_gives(
    motorcycle, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right, _ = motorcycle
    whole = semi_global_matching(left, right, (0, 63))
    monkeypatch.setattr(module, "VOLUME_BYTES", 3 * left.shape[1] * 64 * 100)
    bands = semi_global_matching(left, right, (0, 63))
    both = whole.consistent & bands.consistent
    assert both.mean() > 0.97 * whole.consistent.mean()
    assert np.mean(np.abs(whole.disparity - bands.disparity)[both] > 1) < 0.01
    assert not np.array_equal(whole.uniqueness_ratio, bands.uniqueness_ratio)  # there were bands


def test_disparities_stay_in_their_range() -> None:
    generator = np.random.default_rng(0)
    left, right = (generator.integers(0, 256, (30, 50), np.uint8) for _ in range(2))
    for search in ((-7, 4), (3, 3), (-49, 49)):
        found = semi_global_matching(left, right, search)
        inside = found.disparity[found.consistent]
        assert ((inside >= search[0]) & (inside <= search[1])).all()
        _, column = np.nonzero(found.consistent)
        there = column - np.rint(inside)
        assert ((there >= 0) & (there < 50)).all()
        assert (found.uniqueness_ratio[found.consistent] >= 0).all()


def test_matches_of_noisy_views_are_more_distant(motorcycle) -> None:
    left, right, truth = motorcycle
    generator = np.random.default_rng(0)
    row, column = np.nonzero(np.isfinite(truth) & (np.arange(truth.shape[1]) - truth >= 0))
    before = 0.0
    for noise in (0, 4, 12):
        words = [
            census(np.clip(view + generator.normal(0, noise, view.shape), 0, 255).astype(np.uint8))
            for view in (left, right)
        ]
        found = match_distance(words, (0, 63))
        cost = matching_cost(words, 0, 64) / module.COST_PER_BIT
        true = cost[row, column, np.rint(truth[row, column]).astype(int)]
        # The matches that are found are the clearer half of the true ones.
        assert np.quantile(true, 0.1) < found < np.quantile(true, 0.6)
        assert found > before + 2
        before = found


def test_what_is_out_of_sight_takes_no_place_inside(rectified_pair) -> None:
    """The surface that leaves the right image carries its disparity on."""
    shape = (60, 160)
    column = np.arange(shape[1])
    for surface in (14.0, -14.0, 30.0):
        left, right = rectified_pair(np.full(shape, surface))
        found = semi_global_matching(left, right, (-40, 40))
        outside = (column - surface < 0) | (column - surface > shape[1] - 1)
        assert not found.consistent[:, outside].any()
        assert (np.abs(found.disparity - surface)[:, outside] <= 1).mean() > 0.95
        assert found.consistent[:, ~outside].mean() > 0.99
        place = column - found.disparity
        leaves = (place < 0) | (place > shape[1] - 1)
        assert (found.uniqueness_ratio[leaves & ~found.consistent] == 1).mean() > 0.99


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
