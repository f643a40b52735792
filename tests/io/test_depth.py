from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from deepdetect.io.depth import _scale, save_depth_png


@pytest.fixture
def depth() -> np.ndarray:
    rng = np.random.default_rng(0)
    values = rng.uniform(500, 3000, (40, 60)).astype(np.float32)
    values[:5] = np.nan
    values[5, :3] = [0, -4, np.inf]
    return values


def test_opencv_reads_the_values_by_the_formula(depth: np.ndarray, tmp_path: Path) -> None:
    told = save_depth_png(depth, tmp_path / "d.png", "mm")
    stored = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    known = stored > 0
    np.testing.assert_array_equal(known, np.isfinite(depth) & (depth > 0))
    assert told["known_pixels"] == known.sum()
    assert told["out_of_range"] == 0
    error = np.abs(stored[known] / told["value_per_unit"] - depth[known])
    assert error.max() <= 0.5 / told["value_per_unit"] * (1 + 1e-3)
    with Image.open(tmp_path / "d.png") as image:
        assert image.info["unit"] == "mm"
        assert float(image.info["value_per_unit"]) == told["value_per_unit"]


def test_one_wild_depth_does_not_make_all_others_coarse(tmp_path: Path) -> None:
    depth = np.linspace(1000, 2000, 1000).reshape(20, 50)
    depth[0, 0] = 1e8
    told = save_depth_png(depth, tmp_path / "d.png", "mm")
    assert told["value_per_unit"] == 5  # up to 13 metres, in fifths of a millimetre
    assert (told["known_pixels"], told["out_of_range"]) == (999, 1)
    assert cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)[0, 0] == 0


@given(st.floats(1e-6, 1e9), st.integers(2, 40))
def test_a_chosen_scale_is_round_fits_and_is_the_finest(far: float, count: int) -> None:
    depths = np.linspace(far / 2, far, count)
    scale = _scale(depths)
    assert np.rint(depths.max() * scale) <= 65535
    digits = f"{scale:.9e}".split("e")[0].rstrip("0").rstrip(".")
    assert digits in ("1", "2", "5")
    assert far * scale * 2.6 > 65535


def test_a_map_without_depths_is_all_unknown(tmp_path: Path) -> None:
    told = save_depth_png(np.full((4, 5), np.nan), tmp_path / "d.png", "mm")
    assert (told["known_pixels"], told["out_of_range"]) == (0, 0)
