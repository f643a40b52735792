from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import LabelOptions, OptionError, fuse
from deepdetect.io.image import luma
from deepdetect.labels import LABEL_SETTINGS, find_label_settings


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
