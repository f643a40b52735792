from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.io.image import luma
from deepdetect_lab.labels import (
    DETECTORS,
    LabelOptions,
    find_label_settings,
    fuse,
)


def write(folder: Path, text: str) -> Path:
    path = folder / "labels.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    from skimage import data

    return data.camera()[100:260, 150:310]


def test_a_file_chooses_detectors_and_settings(tmp_path: Path, gray: np.ndarray) -> None:
    options = find_label_settings(
        write(
            tmp_path,
            'detectors = ["fast"]\n[fast]\nnormal = { threshold = 40, suppression = true }\n'
            "low_visibility = { threshold = 7 }\n",
        )
    )
    normal, low = (dataclasses.replace(options, visibility=name) for name in ("normal", "low"))
    np.testing.assert_array_equal(
        fuse(gray, normal).mask, DETECTORS["fast"].mask(gray, threshold=40, suppression=True)
    )
    np.testing.assert_array_equal(fuse(gray, low).mask, DETECTORS["fast"].mask(gray, threshold=7))


def test_an_unknown_visibility_is_told_the_nearest() -> None:
    with pytest.raises(OptionError, match="'low'"):
        LabelOptions(visibility="lo")


def test_a_whole_number_serves_for_a_fraction() -> None:
    options = LabelOptions(settings={"sobel": {"low_visibility": {"relative_threshold": 1}}})
    assert options.parameters("sobel", "low")["relative_threshold"] == 1
    assert isinstance(options.parameters("sobel", "low")["relative_threshold"], float)


@pytest.mark.parametrize(
    "text",
    [
        'detectors = ["fasst"]',
        "[fast]\nnormal = { treshold = 3 }",
        "[fast]\nnormal = { threshold = 3.5 }",
        "[fast]\nnormal = 3",
        "[fast",
        "[sobel]\nnormal = { kernel_size = 12 }",
        "[shi-tomasi]\nnormal = { minimum_distance = 1e30 }",
        "[orb]\nnormal = { levels = 0x" + "f" * 9000 + " }",
        "a = " + "[" * 15_000,
        "[sobel]\nnormal = { relative_threshold = nan }",
        'detectors = ["sobel"]\n[fast]\nnormal = { threshold = 3 }',
    ],
)
def test_mistakes_in_the_file_are_one_sentence(tmp_path: Path, text: str) -> None:
    with pytest.raises(OptionError, match=r"labels\.toml"):
        find_label_settings(write(tmp_path, text))


NUMBERS = [
    (name, key)
    for name, detector in DETECTORS.items()
    for key, (_, limits) in detector.settings.items()
    if limits
]
EXTREMES = (-(10**400), -(2**31), -1000, -1, 0, 256, 10**6, 2**31 - 1, 2**63, 10**400)
EXTREME_FRACTIONS = (-1e308, -1e30, -1.0, -1e-30, 0.0, 1e-300, 1e10, 1e30, 1e308)


@pytest.mark.parametrize(("name", "key"), NUMBERS)
def test_extreme_settings_are_refused_or_work(name: str, key: str) -> None:
    """OpenCV ends the process at some of them, and runs for minutes at others."""
    image = np.random.default_rng(0).integers(0, 256, (16, 40), np.uint8)
    whole = isinstance(DETECTORS[name].defaults[key], int)
    for value in EXTREMES + (() if whole else EXTREME_FRACTIONS):
        refused: OptionError | None = None
        try:
            options = LabelOptions(settings={name: {"normal": {key: value}}})
        except OptionError as error:
            refused = error
        if refused is None:
            DETECTORS[name].mask(image, **options.parameters(name, "normal"))
        else:
            assert key in str(refused)


@pytest.mark.parametrize(("name", "key"), NUMBERS)
def test_the_ends_of_the_ranges_work(name: str, key: str) -> None:
    default, limits = DETECTORS[name].settings[key]
    kind = type(default)
    for shape in ((16, 16), (16, 200)):
        image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        for value in (limits[0], limits[-1]):
            assert DETECTORS[name].mask(image, **{key: kind(value)}).shape == shape


def test_those_for_geometry_mark_more_and_nothing_less(photo: np.ndarray) -> None:
    sparse, dense = (
        fuse(luma(photo), find_label_settings(name)).mask for name in ("paper", "dense")
    )
    assert (dense | sparse).sum() == dense.sum()
    assert dense.mean() > 1.1 * sparse.mean()
    assert dense.mean() < 0.95


def test_other_detectors_take_their_settings_along() -> None:
    dense = find_label_settings("dense")
    assert dense.with_detectors(("sobel", "fast")).settings == dense.settings
    assert dense.with_detectors(("fast",)) == LabelOptions(("fast",))
