"""Disparity maps and rectified matches, against disparities that are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import ImageError, OptionError
from deepdetect._shared import machine
from deepdetect.matching.stereo import DENSE, DisparityOptions, disparity_map, matching
from deepdetect.matching.stereo.matching import (
    extrapolate_disparity,
    fill_occlusions,
    find_disparity_range,
    near_discontinuity,
    on_occluding_edge,
)
from deepdetect_lab.datasets.middlebury import load_middlebury

SHAPE = (96, 160)
ROW, COLUMN = np.indices(SHAPE)
SURFACES = {
    "level": np.full(SHAPE, 7.3),
    "to the left": np.full(SHAPE, -9.6),
    "far": np.full(SHAPE, 58.5),
    "slanted along": 4 + 0.09 * COLUMN,
    "slanted across": 12 - 0.08 * ROW + 0.03 * COLUMN,
}
IN_SIGHT = {name: COLUMN - surface >= 0 for name, surface in SURFACES.items()}


@pytest.mark.parametrize("name", SURFACES)
def test_planes_are_found_to_subpixel_accuracy(name: str, rectified_pair) -> None:
    found = disparity_map(*rectified_pair(SURFACES[name]))
    assert found.disparity.dtype == np.float32
    np.testing.assert_array_equal(found.matched, np.isfinite(found.disparity))
    errors = found.disparity - SURFACES[name]
    assert np.isfinite(errors).sum() > 0.75 * IN_SIGHT[name].sum()
    errors = np.abs(errors[np.isfinite(errors)])
    assert np.median(errors) < 0.03
    assert np.quantile(errors, 0.99) < 0.25
    assert np.mean(errors > 1) < 0.005


def test_a_slant_has_no_terraces(rectified_pair) -> None:
    surface = 4 + 0.09 * COLUMN
    found = disparity_map(*rectified_pair(surface))
    errors = (found.disparity - surface)[found.matched]
    tenth = ((surface[found.matched] % 1) * 10).astype(int)
    pulls = [float(np.median(errors[tenth == k])) for k in range(10)]
    assert max(pulls) - min(pulls) < 0.06, pulls  # the parabola alone: over 0.2


@pytest.mark.parametrize(
    "light",
    [
        lambda view: 0.55 * view + 40,
        lambda view: 255 * (view / 255) ** 1.8,
        lambda view: view * np.linspace(0.6, 1, SHAPE[1]),
    ],
    ids=["gain and offset", "gamma", "shade"],
)
def test_light_does_not_matter(light, rectified_pair) -> None:
    surface = SURFACES["slanted across"]
    left, right = rectified_pair(surface)
    right = np.rint(light(right.astype(float))).astype(np.uint8)
    found = disparity_map(left, right)
    assert found.matched.sum() > 0.7 * IN_SIGHT["slanted across"].sum()
    errors = np.abs(found.disparity - surface)
    assert np.nanmedian(errors) < 0.05
    assert np.nanmean(errors[np.isfinite(errors)] > 0.5) < 0.005


@pytest.fixture(scope="module")
def two_surfaces(rectified_pair) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A near square before a plane, both views, and the true disparity of the left."""
    back, front = rectified_pair(np.full(SHAPE, 5.0)), rectified_pair(np.full(SHAPE, 17.0), 1)
    here, there = (np.zeros(SHAPE, bool) for _ in range(2))
    here[28:68, 70:110] = True
    there[28:68, 53:93] = True
    left, right = (
        np.where(near, one, other)
        for near, one, other in zip((here, there), front, back, strict=True)
    )
    return left, right, np.where(here, 17.0, 5.0)


def test_what_lies_near_a_discontinuity_is_left_out_unless_asked_for(two_surfaces) -> None:
    left, right, truth = two_surfaces
    shares, counts = [], []
    for options in (
        DisparityOptions(),
        DisparityOptions(discontinuity_margin_px=0),
        DENSE,
    ):
        found = disparity_map(left, right, options)
        known = np.isfinite(found.disparity)
        shares.append(np.mean(np.abs(found.disparity - truth)[known] < 1))
        counts.append(known.sum())
        assert found.matched[known].all() == (not options.fill_occlusions)
    assert shares[0] > 0.99
    assert counts[0] < counts[1] < counts[2]
    assert min(shares) > 0.95


def test_occlusions_get_the_disparity_behind(two_surfaces) -> None:
    left, right, _ = two_surfaces
    hidden = np.s_[32:64, 60:68]  # of the 12 columns beside the square
    found = disparity_map(left, right, DENSE).disparity[hidden]
    assert np.mean(np.abs(found - 5) < 1) > 0.9
    plain = disparity_map(left, right, DisparityOptions(discontinuity_margin_px=0))
    assert np.isnan(plain.disparity[hidden]).mean() > 0.6


def test_keypoints_get_what_the_map_holds(two_surfaces) -> None:
    left, right, truth = two_surfaces
    found = disparity_map(left, right, DENSE)
    assert not (found.matched & np.isnan(found.disparity)).any()
    assert np.nanmean(np.abs(found.disparity - truth) < 1) > 0.95
    xy = np.random.default_rng(0).permutation(np.argwhere(np.ones(SHAPE))[:, ::-1])[:2000]
    sampled = found.at(xy.astype(np.float32))
    column, row = xy.T
    np.testing.assert_array_equal(
        sampled.indices, np.flatnonzero(np.isfinite(found.disparity[row, column]))
    )
    column, row = xy[sampled.indices].T
    np.testing.assert_array_equal(sampled.disparity, found.disparity[row, column])
    np.testing.assert_array_equal(sampled.matched, found.matched[row, column])
    none = found.at(np.empty((0, 2), np.float32))
    assert none.disparity.shape == none.matched.shape == (len(none),) == (0,)


def test_the_range_that_is_given_is_kept(rectified_pair) -> None:
    left, right = rectified_pair(np.full(SHAPE, 7.3))
    found = disparity_map(left, right, DisparityOptions(disparity_range=(0, 12)))
    assert found.matched.mean() > 0.75
    assert found.disparity_range == (0, 12)
    far = disparity_map(left, right, DisparityOptions(disparity_range=(20, 40)))
    assert far.matched.mean() < 0.05


def test_views_of_different_things_match_hardly_anywhere(rectified_pair) -> None:
    level = np.zeros(SHAPE)
    left, right = rectified_pair(level)[0], rectified_pair(level, seed=1)[1]
    assert disparity_map(left, right).matched.mean() < 0.05


def test_flat_images_have_no_match() -> None:
    flat = np.full((40, 60), 128, np.uint8)
    found = disparity_map(flat, flat)
    assert np.isnan(found.disparity).all()
    assert not found.matched.any()


def test_the_result_does_not_depend_on_threads(
    two_surfaces, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right, _ = two_surfaces
    found = []
    for count in (1, 2, 5):
        monkeypatch.setattr(machine, "processor_count", lambda count=count: count)
        found.append(disparity_map(left, right, DENSE))
    for other in found[1:]:
        np.testing.assert_array_equal(found[0].disparity, other.disparity)
        np.testing.assert_array_equal(found[0].matched, other.matched)


OFFSETS = (-60, 0, 25)


def outside(truth: np.ndarray) -> np.ndarray:
    """Return the pixels whose counterpart the right image does not hold."""
    place = np.arange(truth.shape[1]) - truth
    return (place < -0.5) | (place > truth.shape[1] - 0.5)


@pytest.mark.parametrize("offset", OFFSETS)
@pytest.mark.parametrize("options", [DisparityOptions(), DENSE], ids=["strict", "dense"])
def test_what_the_right_image_does_not_hold_is_not_matched(
    offset: int, options: DisparityOptions, rectified_pair
) -> None:
    """Out of sight at the left border, at the right one, or at both."""
    for slope in (0.0, 0.12):
        truth = offset + slope * (COLUMN - 80)
        found = disparity_map(*rectified_pair(truth), options)
        hidden = outside(truth)
        assert (found.matched & hidden).sum() <= 0.02 * hidden.sum()
        given = hidden & np.isfinite(found.disparity)
        assert (np.abs(found.disparity - truth)[given] <= 1).sum() >= 0.97 * given.sum()
        assert given.any() == (options.fill_occlusions and hidden.any())
        seen = ~hidden & np.isfinite(found.disparity)
        assert seen.sum() > 0.75 * (~hidden).sum()
        assert (np.abs(found.disparity - truth)[seen] <= 1).mean() > 0.995


def test_a_surface_of_its_own_out_of_sight_is_not_invented(rectified_pair) -> None:
    """Where another surface begins out of sight nobody knows: no point there is matched."""
    truth = np.where(COLUMN < 12, 22.0, 30.0)
    found = disparity_map(*rectified_pair(truth), DENSE)
    assert not found.matched[:, :29].any()
    assert np.nanmax(np.abs(found.disparity[:, :29] - 30)) <= 1


@pytest.mark.parametrize("offset", [-80, 0, 80])
def test_no_depth_is_invented_on_photographs(offset: int, shared: Path) -> None:
    """Cropped on opposite sides, a pair has an offset of its disparity."""
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    kept = pair.left.shape[1] - abs(offset)
    first, second = max(-offset, 0), max(offset, 0)
    left, right = pair.left[:, first : first + kept], pair.right[:, second : second + kept]
    truth = pair.disparity[:, first : first + kept] + offset
    found = disparity_map(left, right, DENSE)
    hidden = outside(truth)
    errors = np.abs(found.disparity - truth)
    known = np.isfinite(errors)
    assert (errors[hidden & known] <= 1).mean() > 0.5
    assert known[hidden].mean() > 0.1
    assert (found.matched & hidden).sum() < 0.005 * hidden.sum()
    assert (errors[known & ~found.matched] <= 1).mean() > 0.65
    assert (errors[known] <= 1).mean() > 0.9
    assert (errors[known & found.matched] <= 1).mean() > 0.95


def test_the_edge_of_what_hides_has_no_match(two_surfaces, monkeypatch) -> None:
    left, right, truth = two_surfaces
    found = disparity_map(left, right, DENSE)
    monkeypatch.setattr(matching, "OCCLUDING_EDGE_PX", 0)
    plain = disparity_map(left, right, DENSE)
    assert found.matched.sum() < 0.99 * plain.matched.sum()
    assert not (found.matched & ~plain.matched).any()
    shares = [np.mean(np.abs(one.disparity - truth)[one.matched] <= 1) for one in (plain, found)]
    assert shares[1] > shares[0]


def test_what_is_wrong_is_said(photo: np.ndarray) -> None:
    found = disparity_map(photo, photo)
    for keypoints in ([3, 4], [[3.5, 4]], [[-1, 4]], [[photo.shape[1], 4]], [[np.nan, 4]]):
        with pytest.raises(OptionError):
            found.at(np.array(keypoints))
    with pytest.raises(ImageError):
        disparity_map(photo, photo[:, 1:])
    for disparities in ((4, 3), (0.5, 3), (np.nan, 3), (3,), 5):
        with pytest.raises(OptionError):
            DisparityOptions(disparity_range=disparities)
    with pytest.raises(OptionError, match="disparity_range"):
        disparity_map(photo, photo, DisparityOptions(disparity_range=(0, 256)))


WIDE = (200, 480)
WIDE_ROW, WIDE_COLUMN = np.indices(WIDE)


@pytest.mark.parametrize(
    "surface",
    [
        np.full(WIDE, 0.0),
        np.full(WIDE, -60.0),
        np.full(WIDE, 150.0),
        10 + 0.1 * WIDE_COLUMN,
        -20 + 0.2 * WIDE_ROW,
    ],
    ids=["none", "negative", "large", "slanted", "both signs"],
)
def test_the_range_holds_the_disparities_and_not_much_more(surface, smooth_pair) -> None:
    found = find_disparity_range(*smooth_pair(surface))
    seen = surface[(surface <= WIDE_COLUMN) & (WIDE_COLUMN - surface < WIDE[1])]
    low, high = np.quantile(seen, [0.01, 0.99])
    assert found[0] <= low
    assert found[1] >= high
    assert found[1] - found[0] + 1 < 1.5 * (high - low) + 20


@pytest.fixture(scope="module")
def smooth_pair(rectified_pair):
    """Pairs whose texture is still seen on the small copy."""

    def make(surface: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        small = surface[::4, ::4] / 4
        row, column = np.indices(WIDE, np.float32)
        _, right = rectified_pair(small)
        right = cv2.resize(right, WIDE[::-1], interpolation=cv2.INTER_CUBIC)
        there = (column - surface).astype(np.float32)
        left = cv2.remap(right, there, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return left, right

    return make


def test_discontinuities_extend_along_rows_and_columns() -> None:
    disparity = np.zeros((30, 40), np.float32)
    disparity[10:20, 10:20] = 5
    near = near_discontinuity(disparity, np.ones(disparity.shape, bool), 2)
    expected = np.zeros_like(near)
    expected[7:23, 7:23] = True
    expected[7, [7, 22]] = expected[22, [7, 22]] = False  # its corners see no jump
    expected[13:17, 13:17] = False
    np.testing.assert_array_equal(near, expected)


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


LINES = (6, 80)
LINE = np.arange(LINES[1])


def extrapolated(
    disparity: np.ndarray, known: np.ndarray, carried: np.ndarray | None = None
) -> np.ndarray:
    """Extrapolate surfaces that all paths carry on."""
    if carried is None:
        ends = (known.argmax(1), known.shape[1] - 1 - known[:, ::-1].argmax(1))
        first, last = (disparity[np.arange(len(known)), end][:, None] for end in ends)
        carried = np.where(np.arange(known.shape[1]) < ends[0][:, None], first, last)
    return extrapolate_disparity(disparity, known, carried.astype(np.float32))


def on_rows(values: np.ndarray) -> np.ndarray:
    return np.tile(np.asarray(values, np.float32), (LINES[0], 1))


@pytest.mark.parametrize("slope", [0, -0.2])
@pytest.mark.parametrize("right", [False, True], ids=["left border", "right border"])
def test_a_plane_is_extrapolated_to_the_border(slope: float, right: bool) -> None:
    surface = 15 + slope * LINE
    surface = -surface[::-1] if right else surface
    place = LINE - surface
    seen = (place >= 0) & (place <= LINES[1] - 1)
    found = extrapolated(on_rows(surface), on_rows(seen) > 0)
    np.testing.assert_array_equal(np.isfinite(found), on_rows(~seen) > 0)
    np.testing.assert_allclose(found[:, ~seen], on_rows(surface)[:, ~seen], atol=1e-4)


def test_what_the_other_view_would_show_stays_open() -> None:
    """It has no match, so something else is there."""
    found = extrapolated(on_rows(np.full(80, 4)), on_rows(LINE >= 10) > 0)
    np.testing.assert_array_equal(np.isfinite(found), on_rows(LINE < 4) > 0)
    assert np.isnan(extrapolated(on_rows(np.full(80, 4)), on_rows(LINE < 70) > 0)).all()


def test_a_surface_is_extrapolated_half_as_far_as_it_is_seen() -> None:
    surface = np.where(LINE < 50, 40, 20)  # 20 px of it are seen
    found = extrapolated(on_rows(surface), on_rows(LINE >= 30) > 0)
    np.testing.assert_array_equal(np.isfinite(found), on_rows((LINE >= 20) & (LINE < 30)) > 0)


def test_a_bent_surface_is_extrapolated_less_far() -> None:
    reach = []
    for bend in (0, 0.005, 0.02):
        surface = 30 + bend * (LINE - 30.0) ** 2
        found = extrapolated(on_rows(surface), on_rows(LINE >= 30) > 0)
        extended = np.isfinite(found[0])
        reach.append(int(extended.sum()))
        assert (np.abs(found[0] - surface)[extended] < 2).all()
    assert reach[0] > 20
    assert reach[0] > reach[1] > reach[2] > 0


def test_too_little_is_not_extrapolated() -> None:
    known = on_rows((LINE >= 20) & (LINE < 27)) > 0
    surface = on_rows(np.full(80, 25))
    assert np.isnan(extrapolated(surface, known)).all()
    assert np.isfinite(extrapolated(surface, on_rows((LINE >= 20) & (LINE < 30)) > 0)).any()
    assert np.isnan(extrapolated(surface, np.zeros(LINES, bool))).all()
    assert np.isnan(extrapolated(surface, np.ones(LINES, bool))).all()


def test_where_other_paths_bring_another_surface_there_is_none() -> None:
    surface = on_rows(np.full(80, 20))
    known = on_rows(LINE >= 20) > 0
    carried = surface.copy()
    carried[:2] = 28
    carried[2:, 5:8] = 12
    found = extrapolated(surface, known, carried)
    np.testing.assert_array_equal(np.isfinite(found), ~known & (carried == 20))


def test_unknown_pixels_do_not_count() -> None:
    surface = on_rows(15 + 0.1 * LINE)
    known = (LINE >= 17) & (LINE % 3 > 0)
    wild = np.where(known, surface, np.float32(1e6))
    found = extrapolated(wild, on_rows(known) > 0)
    np.testing.assert_allclose(found[:, :16], surface[:, :16], atol=1e-3)
