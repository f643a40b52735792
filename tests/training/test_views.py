from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect.training.darkening import Darkening, DarkeningRange, darken
from deepdetect.training.variation import vary
from deepdetect.training.views import View, render, scale_short_side, views_of

RANGE = DarkeningRange()


@pytest.mark.parametrize(
    ("view", "name"),
    [
        (View(480), "480_normal"),
        (View(240, Darkening(0.3, 0.4)), "240_b0.300c0.400"),
        (View(240, Darkening(0.2345, 1)), "240_b0.234c1.000"),
        (View(240, None, True), "240x_normal"),
        (View(240, Darkening(0.3, 0.4), False, 255), "240v2-000000ff_b0.300c0.400"),
    ],
)
def test_names(view: View, name: str) -> None:
    assert view.name == name


@given(
    name=st.text("abcAB/._äß0", max_size=20),
    short_sides=st.lists(st.integers(16, 999), min_size=1, max_size=4, unique=True).map(tuple),
    variants=st.integers(0, 4),
)
def test_views_of_a_photograph(name: str, short_sides: tuple[int, ...], variants: int) -> None:
    normal, dark = views_of(name, short_sides, RANGE, variants)
    assert normal == tuple(View(side) for side in short_sides)
    assert [view.short_side for view in dark] == [
        side for side in short_sides for _ in range(variants)
    ]
    for view in dark:
        assert RANGE.brightness[0] <= view.darkening.brightness <= RANGE.brightness[1]
        assert RANGE.contrast[0] <= view.darkening.contrast <= RANGE.contrast[1]
        # The name tells all: a view made anew from it is the same.
        light = view.name.partition("_b")[2].partition("c")
        assert Darkening(float(light[0]), float(light[2])) == view.darkening
    assert views_of(name, short_sides, RANGE, variants) == (normal, dark)


def test_varied_views_come_last_and_leave_the_others_alone() -> None:
    plain = views_of("a.jpg", (96, 64), RANGE, 2)
    normal, dark = views_of("a.jpg", (96, 64), RANGE, 2, augmentations=3)
    assert (normal[:2], dark[:4]) == plain
    assert [view.short_side for view in normal[2:] + dark[4:]] == [96] * 6
    assert [view.variation for view in normal[2:]] == [view.variation for view in dark[4:]]
    assert len({view.variation for view in normal}) == 4
    other, _ = views_of("b.jpg", (96, 64), RANGE, 2, augmentations=3)
    assert {view.variation for view in other[2:]}.isdisjoint(v.variation for v in normal[2:])
    assert len({view.name for view in normal + dark}) == 5 + 7


def test_a_varied_view_is_darkened_after_it_is_varied(photo: np.ndarray) -> None:
    bright = render(photo, View(80, None, False, 7))
    np.testing.assert_array_equal(bright, vary(photo, 80, 7))
    dark = render(photo, View(80, Darkening(0.3, 0.4), False, 7))
    np.testing.assert_array_equal(dark, darken(bright, Darkening(0.3, 0.4)))


def test_photographs_differ_in_their_dark_views() -> None:
    names = [f"photo{number}.jpg" for number in range(30)]
    dark = [views_of(name, (480,), RANGE, 2)[1] for name in names]
    assert len({view.darkening for views in dark for view in views}) > 55


@pytest.mark.parametrize(
    ("size", "side", "expected"),
    [
        ((480, 640), 240, (240, 320)),
        ((640, 480), 240, (320, 240)),
        ((100, 100), 50, (50, 50)),
        ((30, 45), 60, (60, 90)),
        ((101, 203), 50, (50, 100)),
        ((16, 16), 17, (17, 17)),
    ],
)
def test_scaled_sizes(size: tuple[int, int], side: int, expected: tuple[int, int]) -> None:
    assert scale_short_side(np.zeros((*size, 3), np.uint8), side).shape == (*expected, 3)


@given(height=st.integers(16, 300), width=st.integers(16, 300), side=st.integers(16, 300))
def test_the_short_side_is_exact_and_the_shape_is_kept(height: int, width: int, side: int) -> None:
    scaled = scale_short_side(np.zeros((height, width, 3), np.uint8), side)
    assert min(scaled.shape[:2]) == side
    factor = side / min(height, width)
    assert scaled.shape[0] == pytest.approx(height * factor, abs=0.5)
    assert scaled.shape[1] == pytest.approx(width * factor, abs=0.5)


def test_shrinking_averages_areas(photo: np.ndarray) -> None:
    sums = photo.astype(int).reshape(64, 4, 64, 4, 3).sum((1, 3))
    assert np.abs(scale_short_side(photo, 64) - sums / 16).max() <= 0.5


def test_an_image_of_the_right_size_is_not_touched(photo: np.ndarray) -> None:
    np.testing.assert_array_equal(scale_short_side(photo, 256), photo)


def test_enlarging_and_shrinking_gives_the_image_back(photo: np.ndarray) -> None:
    twice = scale_short_side(photo, 512)
    assert twice.shape == (512, 512, 3)
    back = scale_short_side(twice, 256)
    assert np.abs(back.astype(int) - photo).mean() < 2


@pytest.mark.parametrize("kind", ["array", "path", "float"])
@pytest.mark.parametrize("darkening", [None, Darkening(0.3, 0.4)])
def test_rendering(
    kind: str, darkening: Darkening | None, photo: np.ndarray, photo_path: Path
) -> None:
    given = {"array": photo, "path": photo_path, "float": photo / 255}[kind]
    view = render(given, View(100, darkening))
    small = scale_short_side(photo, 100)
    expected = small if darkening is None else darken(small, darkening)
    assert view.dtype == np.uint8
    np.testing.assert_array_equal(view, expected)
