from __future__ import annotations

import numpy as np

from deepdetect.matching.stereo.consistency import (
    fill_occlusions,
    filter_speckles,
    near_discontinuity,
    on_occluding_edge,
)


def test_speckles_are_removed_by_their_size() -> None:
    disparity = np.full((30, 40), -3.25, np.float32)
    disparity[5:9, 5:9] = 9  # 16 pixels
    disparity[20:25, 20:30] = 9  # 50
    known = np.ones(disparity.shape, bool)
    known[0] = False
    kept = filter_speckles(disparity, known, 20)
    assert not kept[5:9, 5:9].any()
    assert not kept[0].any()
    assert kept[20:25, 20:30].all()
    assert kept.sum() == known.sum() - 16
    assert disparity[5, 5] == 9


def test_a_slope_is_no_speckle_and_no_discontinuity() -> None:
    row, column = np.indices((30, 40))
    slope = (0.4 * column - 0.5 * row).astype(np.float32)
    known = np.ones(slope.shape, bool)
    assert filter_speckles(slope, known, 100).all()
    assert not near_discontinuity(slope, known, 4).any()


def test_discontinuities_extend_along_rows_and_columns() -> None:
    disparity = np.zeros((30, 40), np.float32)
    disparity[10:20, 10:20] = 5
    near = near_discontinuity(disparity, np.ones(disparity.shape, bool), 2)
    expected = np.zeros_like(near)
    expected[7:23, 7:23] = True
    expected[7, [7, 22]] = expected[22, [7, 22]] = False  # its corners see no jump
    expected[13:17, 13:17] = False
    np.testing.assert_array_equal(near, expected)


def test_across_a_gap_there_is_a_discontinuity_where_the_depth_jumps() -> None:
    disparity = np.zeros((5, 30), np.float32)
    disparity[:, 20:] = 6
    known = np.ones(disparity.shape, bool)
    known[:, 14:20] = False
    near = near_discontinuity(disparity, known, 3)
    assert near[:, 16:23].all()
    assert not near[:, :15].any()


def test_occlusions_are_filled_from_the_farther_side() -> None:
    disparity = np.array([[4, 0, 0, 0, 9, 9, 0, 0]], np.float32)
    known = disparity > 0
    whole, between = fill_occlusions(disparity, known)
    np.testing.assert_array_equal(whole, [[4, 4, 4, 4, 9, 9, 9, 9]])
    np.testing.assert_array_equal(between & ~known, [[0, 1, 1, 1, 0, 0, 0, 0]])


def test_a_gap_wider_than_an_occlusion_stays() -> None:
    disparity = np.zeros((2, 60), np.float32)
    disparity[1, 40:] = 30
    known = np.ones(disparity.shape, bool)
    known[:, 20:40] = False
    _, between = fill_occlusions(disparity, known)
    assert not between[0, 20:40].any()  # nothing near hides these twenty
    assert between[1, 20:40].all()


def test_the_edge_of_what_hides_is_its_outermost_pixels() -> None:
    disparity = np.zeros((30, 40), np.float32)
    disparity[10:20, 10:20] = 5
    known = np.ones(disparity.shape, bool)
    for distance in (1, 2):
        expected = disparity > 0
        expected[10 + distance : 20 - distance, 10 + distance : 20 - distance] = False
        np.testing.assert_array_equal(on_occluding_edge(disparity, known, distance), expected)


def test_what_is_not_known_is_no_edge() -> None:
    disparity = np.full((3, 12), 5, np.float32)
    known = np.ones(disparity.shape, bool)
    known[:, 4:7] = False
    disparity[:, 7:] = 2
    found = on_occluding_edge(disparity, known, 1)
    np.testing.assert_array_equal(np.flatnonzero(found[1]), [3])  # the farther one fills the gap
