from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from deepdetect import OptionError
from deepdetect.io.image import luma
from deepdetect.labels import (
    LABEL_SETTINGS,
    LabelOptions,
    SettingChange,
    find_label_settings,
    fuse,
    read_label_settings,
)
from deepdetect.labels.detectors import (
    DETECTOR_NAMES,
    DETECTORS,
    FastSettings,
    LabelDetector,
    fast_mask,
    run_detector,
    select_detectors,
)
from deepdetect.labels.settings import settings_for


def write(folder: Path, text: str) -> Path:
    path = folder / "labels.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def gray() -> np.ndarray:
    from skimage import data

    return data.camera()[100:260, 150:310]


def test_a_file_chooses_detectors_and_settings(tmp_path: Path, gray: np.ndarray) -> None:
    settings = read_label_settings(
        write(
            tmp_path,
            'detectors = ["fast"]\n[fast]\nnormal = { threshold = 40, suppression = true }\n'
            "low_visibility = { threshold = 7 }\n",
        )
    )
    options = LabelOptions(settings.detectors, "normal", settings.changes)
    np.testing.assert_array_equal(fuse(gray, options).mask, fast_mask(gray, FastSettings(40, True)))
    low = LabelOptions(settings.detectors, "low", settings.changes)
    np.testing.assert_array_equal(fuse(gray, low).mask, fast_mask(gray, FastSettings(7)))


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    settings = read_label_settings(write(tmp_path, ""))
    assert settings.detectors == DETECTOR_NAMES
    assert settings.changes == ()


def test_a_whole_number_serves_for_a_fraction() -> None:
    assert SettingChange("sobel", "low", "relative_threshold", 1).value == 1


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ('detectors = ["fasst"]', "did you mean 'fast'"),
        ('detectors = "fast"', "list of names"),
        ("[fasst]\nnormal = { threshold = 3 }", "did you mean 'fast'"),
        ("[fast]\nnormall = { threshold = 3 }", "did you mean 'normal'"),
        ("[fast]\nnormal = { treshold = 3 }", "did you mean 'threshold'"),
        ("[fast]\nnormal = { threshold = 3.5 }", "type int"),
        ("[fast]\nnormal = { suppression = 1 }", "type bool"),
        ("[fast]\nnormal = 3", "must be a table"),
        ("fast = 3", "must be a table"),
        ("[fast", "no valid TOML"),
        ("[sobel]\nnormal = { kernel_size = 12 }", "settings of sobel: `kernel_size` must be odd"),
        (
            "[orb]\nnormal = { levels = 0 }",
            r"settings of orb: `levels` must lie in \[1, 32\], not 0",
        ),
        ("[shi-tomasi]\nnormal = { minimum_distance = 1e30 }", r"must lie in \[0, 1000\]"),
        ("[harris]\nlow_visibility = { block_size = 1000000 }", r"must lie in \[1, 255\]"),
        ("[orb]\nnormal = { levels = 0x" + "f" * 9000 + " }", "must be finite"),
        ("[orb]\nnormal = { levels = " + "9" * 9000 + " }", "no valid TOML"),
        ("a = " + "[" * 15_000, "nested too deep"),
        ("a" + ".a" * 50_000 + " = 1", "longer than 16000 bytes"),
        ("[sobel]\nnormal = { relative_threshold = nan }", "must be finite"),
        ('detectors = ["sobel"]\n[fast]\nnormal = { threshold = 3 }', "not among the detectors"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, text: str, hint: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(OptionError, match=hint):
        read_label_settings(path)


def test_a_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "labels.toml"
    path.write_text('\ufeffdetectors = ["fast"]', encoding="utf-8")
    assert read_label_settings(path).detectors == ("fast",)


NUMBERS = [
    (detector, field.name)
    for detector in DETECTORS
    for field in dataclasses.fields(detector.normal)
    if not isinstance(getattr(detector.normal, field.name), bool)
]
EXTREMES = (-(10**400), -(2**31), -1000, -1, 0, 256, 10**6, 2**31 - 1, 2**63, 10**400)
EXTREME_FRACTIONS = (-1e308, -1e30, -1.0, -1e-30, 0.0, 1e-300, 1e10, 1e30, 1e308)


@pytest.mark.parametrize(
    ("detector", "name"), NUMBERS, ids=lambda value: getattr(value, "name", value)
)
def test_extreme_settings_are_refused_or_work(
    detector: LabelDetector, name: str, one_line: Callable[[BaseException], str]
) -> None:
    """OpenCV ends the process at some of them, and runs for minutes at others."""
    image = np.random.default_rng(0).integers(0, 256, (16, 40), np.uint8)
    whole = isinstance(getattr(detector.normal, name), int)
    for value in EXTREMES + (() if whole else EXTREME_FRACTIONS):
        try:
            change = SettingChange(detector.name, "normal", name, value)
        except OptionError as error:
            message = one_line(error)
            assert name in message
            assert detector.name in message
            assert f"`{name}` must" in message or "must be finite" in message
            continue
        run_detector(detector, image, settings_for(detector, "normal", [change]))


@pytest.mark.parametrize(
    ("detector", "name"), NUMBERS, ids=lambda value: getattr(value, "name", value)
)
def test_the_ends_of_the_ranges_work(detector: LabelDetector, name: str) -> None:
    with pytest.raises(OptionError, match=f"`{name}` must") as caught:
        dataclasses.replace(detector.normal, **{name: -7})
    ends = re.search(r"\[(.+), (.+)\]", str(caught.value))
    kind = type(getattr(detector.normal, name))
    low, high = (float(end) for end in ends.groups()) if ends else (1, 31)  # of odd numbers
    for shape in ((16, 16), (16, 200), (64, 64)):
        image = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        for value in (low, high):
            settings = dataclasses.replace(detector.normal, **{name: kind(value)})
            assert run_detector(detector, image, settings).shape == shape


def test_pyramids_end_with_the_image(gray: np.ndarray) -> None:
    small = gray[:16, :60]
    for name, most in (("orb", {"levels": 32, "scale_factor": 10.0}), ("brisk", {"octaves": 16})):
        detector = next(entry for entry in DETECTORS if entry.name == name)
        settings = dataclasses.replace(detector.normal, **most)
        assert run_detector(detector, small, settings).shape == small.shape


def test_what_opencv_refuses_is_one_sentence(
    gray: np.ndarray, one_line: Callable[[BaseException], str]
) -> None:
    def refuse(gray: np.ndarray, settings: FastSettings) -> np.ndarray:
        return cv2.Sobel(gray, cv2.CV_64F, 1, 0, ksize=4) > settings.threshold

    detector = dataclasses.replace(select_detectors(["fast"])[0], mask=refuse)
    with pytest.raises(OptionError) as caught:
        run_detector(detector, gray, FastSettings())
    assert "OpenCV refuses FastSettings(threshold=13" in one_line(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"none\.toml cannot be read"):
        read_label_settings(tmp_path / "none.toml")


def test_the_order_in_the_file_says_nothing(tmp_path: Path) -> None:
    first = read_label_settings(
        write(
            tmp_path,
            "[sobel]\nnormal = { relative_threshold = 1 }\n[fast]\nnormal = { threshold = 9 }",
        )
    )
    second = read_label_settings(
        write(
            tmp_path,
            "[fast]\nnormal = { threshold = 9 }\n[sobel]\nnormal = { relative_threshold = 1.0 }",
        )
    )
    assert first == second


def options(name: str) -> LabelOptions:
    chosen = find_label_settings(name)
    return LabelOptions(chosen.detectors, changes=chosen.changes)


def test_the_paper_s_are_the_default() -> None:
    assert options("paper") == LabelOptions()


def test_those_for_geometry_mark_more_and_nothing_less(photo: np.ndarray) -> None:
    sparse = fuse(luma(photo), options("paper")).mask
    dense = fuse(luma(photo), options("dense")).mask
    assert (dense | sparse).sum() == dense.sum()
    assert dense.mean() > 1.1 * sparse.mean()
    assert dense.mean() < 0.95


def test_a_file_is_read_and_a_word_is_a_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("[fast]\nnormal = { threshold = 20 }\n")
    (change,) = find_label_settings(path).changes
    assert change.value == 20
    assert set(LABEL_SETTINGS) == {"paper", "dense"}
    with pytest.raises(OptionError, match="did you mean 'dense'"):
        find_label_settings("densee")
