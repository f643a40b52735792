"""One range of values for the deep images of a call, robust to single pixels."""

from __future__ import annotations

import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import load_image
from deepdetect.io.image import load_pair, load_pixels, one_range
from deepdetect.io.image_file import read_with

RNG = np.random.default_rng(0)


def photograph(bits: int, size: tuple[int, int] = (100, 120)) -> np.ndarray:
    """Return a uint16 image that uses all values of a sensor."""
    values = np.linspace(1, 2**bits - 1, size[0] * size[1])
    return RNG.permutation(np.rint(values)).reshape(size).astype(np.uint16)


def levels(image: np.ndarray, low: float, high: float) -> np.ndarray:
    scaled = (image.astype(float) - low) * 255 / (high - low)
    return np.repeat(np.rint(scaled.clip(0, 255))[..., None], 3, axis=2).astype(np.uint8)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("hot", [0, 1, 9])
@pytest.mark.parametrize("lowest", [0.06, 1])
def test_single_pixels_change_nothing_else(bits: int, hot: int, lowest: float) -> None:
    image = photograph(bits)
    image[0, :hot], image[1, :hot] = np.linspace(max(2**bits, lowest * 65535), 65535, hot), 0
    np.testing.assert_array_equal(load_image(image), levels(image, 0, 2**bits - 1))


def test_padding_with_65535_is_white() -> None:
    image = photograph(12)
    image[:30] = 65535
    np.testing.assert_array_equal(load_image(image), levels(image, 0, 4095))


def test_highlights_that_are_more_than_single_pixels_are_in_the_range() -> None:
    image = photograph(10)
    image[0, :40] = np.linspace(1100, 65000, 40)
    with pytest.warns(UserWarning, match="value_range"):
        found = load_image(image)
    np.testing.assert_array_equal(found, levels(image, 0, 65535))


@pytest.mark.parametrize(("low", "high"), [(6750, 7080), (30000, 31000), (20000, 20040)])
def test_a_narrow_band_uses_the_levels_there_are(low: int, high: int) -> None:
    band = RNG.integers(low, high + 1, (100, 120)).astype(np.uint16)
    with pytest.warns(UserWarning, match="value_range"):
        found = load_image(band)
    assert len(np.unique(found)) >= min(high - low, 250)
    dead = band.copy()
    dead[5, 5], dead[50] = 65535, 0  # a hot pixel, and a row without data
    with pytest.warns(UserWarning, match="value_range"):
        other = load_image(dead)
    kept = np.ones(band.shape, bool)
    kept[5, 5], kept[50] = False, False
    assert np.abs(found[kept].astype(int) - other[kept]).max() <= 1


def test_a_dark_photograph_stays_as_it_is() -> None:
    dark = RNG.integers(0, 25, (100, 120)).astype(np.uint16)
    with pytest.warns(UserWarning, match="value_range"):
        found = load_image(dark)
    np.testing.assert_array_equal(found, levels(dark, 0, 255))


def test_a_pair_has_one_range(tmp_path: Path) -> None:
    dark, bright = photograph(10), photograph(12)
    paths = [tmp_path / "dark.png", tmp_path / "bright.png"]
    for path, image in zip(paths, (dark, bright), strict=True):
        cv2.imwrite(str(path), image)
    for given in ((dark, bright), (bright, dark), paths, [path.read_bytes() for path in paths]):
        rgb, _ = load_pair((given[0], given[1]), "rgb")
        found = {int(image.max()) for image in rgb}
        assert found == {255, round(1023 / 4095 * 255)}
    np.testing.assert_array_equal(load_image(paths[0]), levels(dark, 0, 1023))


def test_what_does_not_fit_the_range_of_a_folder_is_told(tmp_path: Path) -> None:
    paths = []
    for number in range(17):
        paths.append(tmp_path / f"{number:02}.png")
        cv2.imwrite(str(paths[-1]), photograph(14 if number == 1 else 12))  # 1 is not looked at
    with one_range(paths) as reading:
        pass
    with read_with(reading):
        assert load_image(paths[5]).max() == 255
        with pytest.warns(UserWarning, match="value_range"):
            load_image(paths[1])


@pytest.mark.parametrize("share", [0.005, 0.03])
def test_a_flame_that_leaves_few_levels_to_the_rest_is_told(share: float) -> None:
    cool = RNG.integers(7000, 7400, (100, 120)).astype(np.uint16)
    flame = cool.copy()
    flame[: round(100 * share**0.5), : round(120 * share**0.5)] = 16000
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always")
        with one_range([cool, flame]) as reading:
            pass
    with read_with(reading), pytest.warns(UserWarning, match="value_range"):
        assert len(np.unique(load_image(cool))) < 16


def test_images_of_8_bits_have_no_common_range() -> None:
    small = RNG.integers(0, 256, (100, 120)).astype(np.uint8)
    with one_range([small, small]) as reading:
        assert reading.deep_range is None
    with one_range([small, photograph(12), photograph(10)]) as reading:
        assert reading.deep_range == (0, 4095)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_pixels(photograph(12), deep=True).dtype == np.uint16
