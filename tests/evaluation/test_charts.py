from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from PIL import Image

from deepdetect import MissingExtraError
from deepdetect.evaluation.charts import (
    WIDEST,
    bar_chart,
    line_chart,
    picture,
)

pytest.importorskip("matplotlib", reason="needs matplotlib, which draws the charts")


def decoded(png: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))


def test_a_picture_is_kept_to_the_pixel(photo: np.ndarray) -> None:
    np.testing.assert_array_equal(decoded(picture(photo)), photo)


def test_a_wide_picture_is_shrunk_in_proportion(photo: np.ndarray) -> None:
    wide = np.repeat(photo, 8, axis=1)
    assert decoded(picture(wide)).shape == (200, WIDEST, 3)
    exact = np.zeros((20, WIDEST, 3), np.uint8)
    assert decoded(picture(exact)).shape == exact.shape


def test_more_bars_make_a_higher_chart() -> None:
    few = decoded(bar_chart({"a": 0.2, "b": 0.1}, "share"))
    many = decoded(bar_chart({str(k): 0.5 for k in range(12)}, "share"))
    assert many.shape[0] > 2 * few.shape[0]
    assert many.shape[1] == few.shape[1]


def test_the_best_bars_have_another_colour() -> None:
    orange = (255, 127, 14)
    assert not (decoded(bar_chart({"a": 0.5, "b": 0.5}, "share")) == orange).all(2).any()
    assert (decoded(bar_chart({"a": 0.5, "b": 0.5}, "share", ["b"])) == orange).all(2).any()


def test_names_of_any_kind_are_drawn() -> None:
    assert len(bar_chart({"$a_b$ & <c> 100 %": 0.5, "_hidden": 0.0}, "x")) > 1000
    assert len(line_chart({"$1 & $2": ([1, 2], [0.5, float("nan")])}, "x", "y")) > 1000
    assert len(line_chart({}, "x", "y", logarithmic=True)) > 1000


def test_logarithmic_axes_put_doublings_at_equal_distances() -> None:
    """The second of three points at 1, 2 and 4 is halfway, as that at 0, 1 and 2 otherwise."""
    colors = np.array([(31, 119, 180), (255, 127, 14), (44, 160, 44)])
    for values, logarithmic in (((1, 2, 4), True), ((0, 1, 2), False)):
        lines = {name: ([x], [1.0]) for name, x in zip("abc", values, strict=True)}
        lines["d"] = [values[0]], [0.0]
        drawn = decoded(line_chart(lines, "x", "y", logarithmic=logarithmic))
        drawn = drawn[: len(drawn) // 3]  # above the legend
        left, middle, right = (np.nonzero((drawn == c).all(2))[1].mean() for c in colors)
        assert middle == pytest.approx((left + right) / 2, abs=2)


def test_the_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, one_line) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(MissingExtraError, match="matplotlib") as caught:
        bar_chart({"a": 1}, "x")
    assert "pip install" in one_line(caught.value)
