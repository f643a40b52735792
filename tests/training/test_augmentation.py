from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from deepdetect.io.image import luma
from deepdetect.labels import DETECTOR_NAMES, LabelOptions, fuse
from deepdetect.training.augmentation import flip, transpose, turn_hue, without_color

IMAGES = arrays(np.uint8, (6, 7, 3))


def test_mirrors_move_image_and_label_together() -> None:
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    mask = image[..., 0] % 2 == 0
    for made, expected in (
        (flip(image, mask, 1), np.s_[:, ::-1]),
        (flip(image, mask, 0), np.s_[::-1]),
    ):
        np.testing.assert_array_equal(made[0], image[expected])
        np.testing.assert_array_equal(made[1], mask[expected])
    turned, turned_mask = transpose(image, mask)
    np.testing.assert_array_equal(turned, image.transpose(1, 0, 2))
    np.testing.assert_array_equal(turned_mask, mask.T)
    assert turned_mask.dtype == bool


@pytest.mark.parametrize("name", DETECTOR_NAMES)
def test_a_transposed_photograph_has_the_transposed_label(name: str, photo: np.ndarray) -> None:
    options = LabelOptions((name,))
    mask = fuse(luma(photo), options).mask
    turned, expected = transpose(photo, mask)
    found = fuse(luma(turned), options).mask
    # BRISK's scale space is not quite the same along both axes.
    assert (found & expected).sum() >= (0.9 if name == "brisk" else 0.999) * (
        found | expected
    ).sum()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("name", "least", "most"),
    [
        ("shi-tomasi", 0, 0.1),
        ("sift", 0.1, 0.6),
        ("orb", 0.3, 0.8),
        ("brisk", 0.4, 0.97),
        ("canny", 0.97, 1),
        ("fast", 1, 1),
        ("agast", 1, 1),
        ("harris", 0.999, 1),
        ("sobel", 0.999, 1),
    ],
)
def test_a_mirrored_photograph_has_another_label(
    name: str, least: float, most: float, axis: int, photo: np.ndarray
) -> None:
    """Why crops are not flipped: OpenCV's Shi-Tomasi, for one, marks the pixel beside."""
    options = LabelOptions((name,))
    flipped, expected = flip(photo, fuse(luma(photo), options).mask, axis)
    found = fuse(luma(flipped), options).mask
    assert least <= (found & expected).sum() / (found | expected).sum() <= most


@given(image=IMAGES)
def test_without_color_the_luma_is_the_same(image: np.ndarray) -> None:
    gray = without_color(image)
    np.testing.assert_array_equal(luma(gray), luma(image))
    assert (gray == gray[..., :1]).all()


@given(image=IMAGES, angle=st.floats(0, 7), saturation=st.floats(0, 2))
def test_other_colors_have_the_same_luma(
    image: np.ndarray, angle: float, saturation: float
) -> None:
    turned = turn_hue(image, angle, saturation)
    assert turned.dtype == np.uint8
    assert np.abs(luma(turned).astype(int) - luma(image)).max() <= 1


def test_a_turn_of_nothing_changes_nothing_and_a_half_turn_complements(photo: np.ndarray) -> None:
    assert np.abs(turn_hue(photo, 0, 1).astype(int) - photo).max() <= 1
    assert np.abs(turn_hue(photo, 0, 0).astype(int) - without_color(photo)).max() <= 1
    pale = (photo // 4 + 96).astype(np.uint8)
    twice = turn_hue(turn_hue(pale, math.pi, 1), math.pi, 1)
    assert np.abs(twice.astype(int) - pale).max() <= 3
    assert np.abs(turn_hue(pale, math.pi, 1).astype(int) - pale).max() > 20


def test_the_label_hardly_changes_with_the_colors(photo: np.ndarray) -> None:
    mask = fuse(luma(photo)).mask
    found = fuse(luma(turn_hue(photo, 2.0, 1.0))).mask
    assert (found & mask).sum() > 0.97 * (found | mask).sum()
