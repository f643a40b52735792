from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect import ImageError
from deepdetect_lab.training.augmentation import (
    BRIGHTNESS,
    CONTRAST,
    Darkening,
    augment,
    darken,
)
from deepdetect_lab.training.recipe import Stage
from deepdetect_lab.training.views import (
    SourceImage,
    View,
    render,
    train_val_split,
    views_of,
)

from .conftest import plain_options

OPTIONS = plain_options(stages=(Stage(64, 2, 1),), short_sides=(96, 64))


def images(count: int) -> list[SourceImage]:
    return [SourceImage(Path(f"photo{k}.jpg"), f"{k:08x}", (), ()) for k in range(count)]


def test_names_are_those_of_the_labels_on_disk() -> None:
    assert View(240, None, "squash").name == "240x_normal"
    assert View(240, Darkening(0.2345, 1)).name == "240_b0.234c1.000"
    assert View(240, Darkening(0.3, 0.4), None, 255).name == "240v3-000000ff_b0.300c0.400"


@given(
    name=st.text("abcAB/._äß0", max_size=20),
    short_sides=st.lists(st.integers(64, 999), min_size=1, max_size=4, unique=True).map(tuple),
)
def test_views_of_an_image(name: str, short_sides: tuple[int, ...]) -> None:
    options = plain_options(stages=OPTIONS.stages, short_sides=short_sides)
    normal, dark = views_of(name, options)
    assert normal == tuple(View(side) for side in short_sides)
    assert [view.short_side for view in dark] == list(short_sides)
    for view in dark:
        assert BRIGHTNESS[0] <= view.darkening.brightness <= BRIGHTNESS[1]
        assert CONTRAST[0] <= view.darkening.contrast <= CONTRAST[1]
        # The name holds the exact factors.
        light = view.name.partition("_b")[2].partition("c")
        assert Darkening(float(light[0]), float(light[2])) == view.darkening
    assert views_of(name, options) == (normal, dark)


def test_augmented_views_come_last_and_leave_the_others_alone() -> None:
    plain = views_of("a.jpg", OPTIONS)
    options = dataclasses.replace(OPTIONS, augmentations=3)
    normal, dark = views_of("a.jpg", options)
    assert (normal[:2], dark[:2]) == plain
    assert [view.short_side for view in normal[2:] + dark[2:]] == [96] * 6
    assert [view.augmentation for view in normal[2:]] == [view.augmentation for view in dark[2:]]
    assert len({view.augmentation for view in normal}) == 4
    other, _ = views_of("b.jpg", options)
    assert {view.augmentation for view in other[2:]}.isdisjoint(v.augmentation for v in normal[2:])
    assert len({view.name for view in normal + dark}) == 5 + 5


def test_an_augmented_view_is_darkened_last(photo: np.ndarray) -> None:
    bright = render(photo, View(80, None, None, 7))
    np.testing.assert_array_equal(bright, augment(photo, 80, 7))
    dark = render(photo, View(80, Darkening(0.3, 0.4), None, 7))
    np.testing.assert_array_equal(dark, darken(bright, Darkening(0.3, 0.4)))


def test_a_square_view_is_squashed(photo: np.ndarray) -> None:
    wide = photo[:128]
    expected = cv2.resize(wide, (64, 64), interpolation=cv2.INTER_CUBIC)
    np.testing.assert_array_equal(render(wide, View(64, square="squash")), expected)
    np.testing.assert_array_equal(render(photo, View(256, square="squash")), photo)


def test_the_middle_square_is_cut_out(photo: np.ndarray) -> None:
    wide = photo[40:136]
    found = render(wide, View(48, square="crop"))
    np.testing.assert_array_equal(found, render(wide[:, 80:176], View(48)))
    np.testing.assert_array_equal(render(photo, View(256, square="crop")), photo)


def test_one_in_twenty_is_held_out_and_nothing_is_in_both() -> None:
    kept, held = train_val_split(images(4000))
    assert 150 < len(held) < 250
    assert len(kept) + len(held) == 4000
    assert not {image.path for image in kept} & {image.path for image in held}


def test_photographs_keep_their_side_when_others_come() -> None:
    _, before = train_val_split(images(500))
    _, after = train_val_split(images(1000))
    assert {image.path for image in before} <= {image.path for image in after}


def test_few_photographs_still_give_one_for_validation() -> None:
    kept, held = train_val_split(images(2))
    assert (len(kept), len(held)) == (1, 1)
    with pytest.raises(ImageError):
        train_val_split(images(1))
