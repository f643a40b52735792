from __future__ import annotations

from pathlib import Path

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
from deepdetect.labels.detectors import DETECTOR_NAMES, FastSettings, fast_mask


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
        ("[sobel]\nnormal = { kernel_size = 12 }", "OpenCV refuses the settings of sobel"),
        ("[sobel]\nnormal = { relative_threshold = nan }", "must be finite"),
        ('detectors = ["sobel"]\n[fast]\nnormal = { threshold = 3 }', "not among the detectors"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, text: str, hint: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(OptionError, match=hint):
        read_label_settings(path)


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
