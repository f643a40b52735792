"""Matches along rows, against disparities that are known."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import ImageError, OptionError
from deepdetect._shared import parallel
from deepdetect.datasets.middlebury import load_middlebury
from deepdetect.reconstruction.stereo import COMPLETE, RowMatches, RowMatchingOptions, match_rows

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


def as_map(found: RowMatches, xy: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    out = np.full(shape[:2], np.nan, np.float32)
    column, row = xy[found.rows].astype(int).T
    out[row, column] = found.disparity
    return out


@pytest.mark.parametrize("name", SURFACES)
def test_planes_are_found_below_the_pixel(name: str, rectified_pair, every_pixel) -> None:
    left, right = rectified_pair(SURFACES[name])
    xy = every_pixel(SHAPE)
    found = match_rows(left, right, xy)
    assert found.disparity.dtype == np.float32
    assert (np.diff(found.rows) > 0).all()
    assert found.matched.all()
    errors = as_map(found, xy, SHAPE) - SURFACES[name]
    assert np.isfinite(errors).sum() > 0.75 * IN_SIGHT[name].sum()
    errors = np.abs(errors[np.isfinite(errors)])
    assert np.median(errors) < 0.03
    assert np.quantile(errors, 0.99) < 0.25
    assert np.mean(errors > 1) < 0.005


def test_a_slant_has_no_terraces(rectified_pair, every_pixel) -> None:
    surface = 4 + 0.09 * COLUMN
    xy = every_pixel(SHAPE)
    found = match_rows(*rectified_pair(surface), xy)
    column, row = xy[found.rows].T
    errors = found.disparity - surface[row, column]
    tenth = ((surface[row, column] % 1) * 10).astype(int)
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
def test_light_does_not_matter(light, rectified_pair, every_pixel) -> None:
    surface = SURFACES["slanted across"]
    left, right = rectified_pair(surface)
    right = np.rint(light(right.astype(float))).astype(np.uint8)
    xy = every_pixel(SHAPE)
    found = match_rows(left, right, xy)
    assert len(found) > 0.7 * IN_SIGHT["slanted across"].sum()
    errors = np.abs(as_map(found, xy, SHAPE) - surface)
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


def test_what_lies_near_a_jump_of_depth_is_left_out_unless_asked_for(
    two_surfaces, every_pixel
) -> None:
    left, right, truth = two_surfaces
    xy = every_pixel(SHAPE)
    shares, counts = [], []
    for options in (
        RowMatchingOptions(),
        RowMatchingOptions(edge_distance=0),
        COMPLETE,
    ):
        found = match_rows(left, right, xy, options)
        errors = np.abs(as_map(found, xy, SHAPE) - truth)
        shares.append(np.mean(errors[np.isfinite(errors)] < 1))
        counts.append(len(found))
        assert found.matched.all() == (not options.fill)
    assert shares[0] > 0.99
    assert counts[0] < counts[1] < counts[2]
    assert min(shares) > 0.95


def test_what_is_hidden_gets_the_disparity_behind(two_surfaces, every_pixel) -> None:
    left, right, _ = two_surfaces
    xy = every_pixel(SHAPE)
    found = match_rows(left, right, xy, COMPLETE)
    hidden = as_map(found, xy, SHAPE)[32:64, 60:68]  # 12 columns beside the square
    assert np.mean(np.abs(hidden - 5) < 1) > 0.9
    plain = match_rows(left, right, xy, RowMatchingOptions(edge_distance=0))
    assert np.isnan(as_map(plain, xy, SHAPE)[32:64, 60:68]).mean() > 0.6


def test_keypoints_get_what_every_pixel_gets(two_surfaces, every_pixel) -> None:
    left, right, _ = two_surfaces
    xy = every_pixel(SHAPE)
    whole = as_map(match_rows(left, right, xy), xy, SHAPE)
    some = np.random.default_rng(0).permutation(xy)[:2000].astype(np.float32)
    found = match_rows(left, right, some)
    np.testing.assert_array_equal(as_map(found, some, SHAPE), np.where(
        np.isfinite(as_map(found, some, SHAPE)), whole, np.nan
    ))  # fmt: skip
    column, row = some.astype(int).T
    assert len(found) == np.isfinite(whole[row, column]).sum()


def test_the_range_that_is_given_is_kept(rectified_pair, every_pixel) -> None:
    left, right = rectified_pair(np.full(SHAPE, 7.3))
    xy = every_pixel(SHAPE)
    found = match_rows(left, right, xy, RowMatchingOptions(search_range=(0, 12)))
    assert (found.search_range.smallest, found.search_range.largest) == (0, 12)
    assert len(found) > 0.75 * xy.shape[0]
    far = match_rows(left, right, xy, RowMatchingOptions(search_range=(20, 40)))
    assert len(far) < 0.05 * xy.shape[0]


def test_views_of_different_things_match_hardly_anywhere(rectified_pair, every_pixel) -> None:
    level = np.zeros(SHAPE)
    left, right = rectified_pair(level)[0], rectified_pair(level, seed=1)[1]
    assert len(match_rows(left, right, every_pixel(SHAPE))) < 0.05 * left.size


def test_equal_views_have_no_disparity(photo: np.ndarray, every_pixel) -> None:
    found = match_rows(photo, photo, every_pixel(photo.shape))
    assert len(found) > 0.9 * photo.shape[0] * photo.shape[1]
    assert np.median(np.abs(found.disparity)) < 0.005
    assert np.abs(found.disparity).max() < 0.25


def test_colour_or_grey_and_any_kind_of_image(photo: np.ndarray, every_pixel) -> None:
    left, right = photo[:, 8:], photo[:, :-8]
    xy = every_pixel(left.shape)
    found = match_rows(left, right, xy)
    gray = [cv2.cvtColor(np.ascontiguousarray(view), cv2.COLOR_RGB2GRAY) for view in (left, right)]
    again = match_rows(*gray, xy)
    np.testing.assert_array_equal(found.disparity, again.disparity)
    assert np.mean(np.abs(found.disparity + 8) < 0.1) > 0.99


@pytest.mark.parametrize("shape", [(16, 16), (16, 40), (33, 17)])
def test_tiny_images(shape: tuple[int, int], rectified_pair, every_pixel) -> None:
    left, right = rectified_pair(np.full(shape, 2.0))
    found = match_rows(left, right, every_pixel(shape), COMPLETE)
    assert np.isfinite(found.disparity).all()
    assert len(found) <= left.size


def test_flat_images_have_no_match(every_pixel) -> None:
    flat = np.full((40, 60), 128, np.uint8)
    found = match_rows(flat, flat, every_pixel(flat.shape))
    assert np.isfinite(found.disparity).all()
    assert len(found) == 0


def test_no_keypoints_no_matches(photo: np.ndarray) -> None:
    found = match_rows(photo, photo, np.empty((0, 2), np.float32))
    assert len(found) == 0
    assert found.disparity.shape == found.matched.shape == (0,)


def test_the_result_does_not_depend_on_threads(
    two_surfaces, every_pixel, monkeypatch: pytest.MonkeyPatch
) -> None:
    left, right, _ = two_surfaces
    xy = every_pixel(SHAPE)
    found = []
    for count in (1, 2, 5):
        monkeypatch.setattr(parallel, "processor_count", lambda count=count: count)
        found.append(match_rows(left, right, xy, COMPLETE))
    for other in found[1:]:
        np.testing.assert_array_equal(found[0].rows, other.rows)
        np.testing.assert_array_equal(found[0].disparity, other.disparity)


def test_a_part_of_cones_against_the_truth(shared: Path, every_pixel) -> None:
    pair = load_middlebury(shared / "data" / "middlebury" / "cones")
    rows = slice(120, 260)
    left, right, truth = pair.left[rows], pair.right[rows], pair.disparity[rows]
    xy = every_pixel(left.shape)
    for options, share, complete in ((RowMatchingOptions(), 0.97, 0.45), (COMPLETE, 0.88, 0.75)):
        errors = np.abs(as_map(match_rows(left, right, xy, options), xy, left.shape) - truth)
        judged = np.isfinite(errors)
        assert np.mean(errors[judged] <= 1) > share
        assert np.sum(errors[judged] <= 1) > complete * np.isfinite(truth).sum()


def test_what_is_wrong_is_said(photo: np.ndarray, one_line) -> None:
    xy = np.array([[3, 4]])
    wrong_keypoints = (
        np.array([3, 4]),
        np.array([[3.5, 4]]),
        np.array([[-1, 4]]),
        np.array([[photo.shape[1], 4]]),
        np.array([[np.nan, 4]]),
        np.array([["a", "b"]]),
    )
    for keypoints in wrong_keypoints:
        with pytest.raises(OptionError) as error:
            match_rows(photo, photo, keypoints)
        one_line(error.value)
    for left, right in ((photo, photo[:, 1:]), (photo[:10], photo[:10]), (photo[0], photo[0])):
        with pytest.raises(ImageError) as error:
            match_rows(left, right, xy)
        one_line(error.value)
    with pytest.raises(OptionError, match="narrow the search range"):
        match_rows(photo, photo, xy, RowMatchingOptions(search_range=(0, 256)))


@pytest.mark.parametrize(
    "values",
    [
        {"search_range": (4, 3)},
        {"search_range": (4,)},
        {"search_range": (0.5, 3)},
        {"uniqueness": 0.9},
        {"uniqueness": float("nan")},
        {"edge_distance": -1},
        {"edge_distance": 101},
    ],
)
def test_options_out_of_range_are_refused(values: dict, one_line) -> None:
    with pytest.raises(OptionError) as error:
        RowMatchingOptions(**values)
    one_line(error.value)
