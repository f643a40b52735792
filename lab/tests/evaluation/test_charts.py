from __future__ import annotations

import io

import numpy as np
from PIL import Image

from deepdetect_lab.evaluation.report import WIDEST, bar_chart, line_chart, picture


def decoded(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def test_a_picture_is_kept_to_the_pixel(photo: np.ndarray) -> None:
    np.testing.assert_array_equal(decoded(picture(photo)), photo)


def test_a_wide_picture_is_shrunk_in_proportion(photo: np.ndarray) -> None:
    wide = np.repeat(photo, 8, axis=1)
    assert decoded(picture(wide)).shape == (200, WIDEST, 3)
    exact = np.zeros((20, WIDEST, 3), np.uint8)
    assert decoded(picture(exact)).shape == exact.shape


def test_names_of_any_kind_are_drawn() -> None:
    assert len(bar_chart({"$a_b$ & <c> 100 %": 0.5, "_hidden": 0.0}, "x")) > 1000
    assert len(line_chart({"$1 & $2": ([1, 2], [0.5, float("nan")])}, "x", "y")) > 1000
    assert len(line_chart({}, "x", "y")) > 1000
