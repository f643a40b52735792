from __future__ import annotations

import io
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from deepdetect._shared.errors import DeepDetectError, ImageError, OptionError
from deepdetect.io.depth import load_depth_png, save_depth_npz, save_depth_png


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
    assert not known[:5].any()
    assert not known[5, :3].any()
    assert known[6:].all()
    assert told.known == known.sum() == 34 * 60 + 57
    assert told.out_of_range == 0
    error = np.abs(stored[known] / told.value_per_unit - depth[known])
    assert error.max() <= 0.5 / told.value_per_unit * (1 + 1e-3)


def test_the_file_tells_its_own_scale(depth: np.ndarray, tmp_path: Path) -> None:
    told = save_depth_png(depth, tmp_path / "d.png", "baseline", value_per_unit=7.3)
    assert told.value_per_unit == 7.3
    read, unit = load_depth_png(tmp_path / "d.png")
    assert unit == "baseline"
    assert read.dtype == np.float32
    unknown = np.isnan(read)
    np.testing.assert_array_equal(unknown, ~(np.isfinite(depth) & (depth > 0)))
    assert np.abs(read - depth)[~unknown].max() <= 0.5 / 7.3 * (1 + 1e-3)


def test_what_does_not_fit_becomes_unknown_and_is_counted(tmp_path: Path) -> None:
    depth = np.array([[0.4, 1.0, 65535.0, 65535.6, 1e9]])
    told = save_depth_png(depth, tmp_path / "d.png", "mm", value_per_unit=1)
    assert (told.known, told.out_of_range) == (2, 3)
    stored = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert stored.tolist() == [[0, 1, 65535, 0, 0]]


def test_one_wild_depth_does_not_make_all_others_coarse(tmp_path: Path) -> None:
    depth = np.linspace(1000, 2000, 1000).reshape(20, 50)
    depth[0, 0] = 1e8
    told = save_depth_png(depth, tmp_path / "d.png", "mm")
    assert told.value_per_unit == 5  # up to 13 metres, in fifths of a millimetre
    assert (told.known, told.out_of_range) == (999, 1)


@given(
    st.floats(1e-6, 1e9),
    st.integers(2, 40),
)
def test_a_chosen_scale_is_round_fits_and_is_the_finest(far: float, count: int) -> None:
    from deepdetect.io.depth import _scale

    depths = np.linspace(far / 2, far, count)
    scale = _scale(depths)
    assert np.rint(depths.max() * scale) <= 65535
    digits = f"{scale:.9e}".split("e")[0].rstrip("0").rstrip(".")
    assert digits in ("1", "2", "5")
    assert far * scale * 2.6 > 65535


def test_a_map_without_depths_is_all_unknown(tmp_path: Path) -> None:
    told = save_depth_png(np.full((4, 5), np.nan), tmp_path / "d.png", "mm")
    assert (told.known, told.out_of_range) == (0, 0)
    assert np.isnan(load_depth_png(tmp_path / "d.png")[0]).all()


def test_npz_keeps_floats_and_further_arrays(depth: np.ndarray, tmp_path: Path) -> None:
    save_depth_npz(depth, tmp_path / "d.npz", "mm", disparity=1 / np.abs(depth + 1))
    with np.load(tmp_path / "d.npz", allow_pickle=False) as read:
        assert str(read["unit"]) == "mm"
        assert read["depth"].dtype == np.float32
        np.testing.assert_array_equal(read["depth"][6:], depth[6:])
        assert np.isnan(read["depth"][5, :3]).all()
        assert read["disparity"].shape == depth.shape


@pytest.mark.parametrize(
    ("values", "name", "unit", "scale", "word"),
    [
        (np.zeros(5), "d.png", "mm", None, "(H, W)"),
        (np.zeros((0, 5)), "d.png", "mm", None, "(H, W)"),
        (np.array([["a"]]), "d.png", "mm", None, "(H, W)"),
        (np.ones((2, 2)), "d.tiff", "mm", None, ".png"),
        (np.ones((2, 2)), "d.png", "m", None, "'mm'"),
        (np.ones((2, 2)), "d.png", "mm", 0.0, "above 0"),
        (np.ones((2, 2)), "d.png", "mm", np.nan, "above 0"),
    ],
)
def test_mistakes_are_one_sentence(
    values: np.ndarray, name: str, unit: str, scale: float | None, word: str,
    tmp_path: Path, one_line,
) -> None:  # fmt: skip
    with pytest.raises(OptionError) as caught:
        save_depth_png(values, tmp_path / name, unit, scale)
    assert word in one_line(caught.value)
    assert not list(tmp_path.iterdir())


def test_npz_asks_for_its_ending(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"\.npz"):
        save_depth_npz(np.ones((2, 2)), tmp_path / "d.np", "mm")


def test_other_pictures_are_no_depth_maps(photo_path: Path, tmp_path: Path, one_line) -> None:
    with pytest.raises(ImageError) as caught:
        load_depth_png(photo_path)
    assert "no depth map" in one_line(caught.value)
    with pytest.raises(DeepDetectError, match="there is no file"):
        load_depth_png(tmp_path / "none.png")


def depth_png(values: np.ndarray, scale: object = 1.0, unit: str = "mm") -> bytes:
    chunks = PngInfo()
    chunks.add_text("value_per_unit", str(scale))
    chunks.add_text("unit", unit)
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG", pnginfo=chunks)
    return file.getvalue()


DEPTH16 = np.arange(600, dtype=np.uint16).reshape(20, 30)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (depth_png(DEPTH16, "nan"), "value_per_unit is nan"),
        (depth_png(DEPTH16, 0), "value_per_unit is 0"),
        (depth_png(DEPTH16, -1), "value_per_unit is -1"),
        (depth_png(DEPTH16, "inf"), "value_per_unit is inf"),
        (depth_png(DEPTH16, "far"), "carries its scale"),
        (depth_png(DEPTH16, unit="furlong"), "its unit is 'furlong' instead of one of mm, base"),
        (depth_png(np.zeros((20, 30, 3), np.uint8)), "RGB instead of 16-bit grey"),
        (depth_png(DEPTH16.astype(np.uint8)), "L instead of 16-bit grey"),
        (depth_png(DEPTH16)[:-30], "damaged"),
    ],
)
def test_what_is_no_depth_map_of_ours_is_refused(content: bytes, words: str, one_line) -> None:
    assert load_depth_png(depth_png(DEPTH16, 2))[0][1, 0] == 15
    with pytest.raises(ImageError) as caught:
        load_depth_png(content)
    assert words in one_line(caught.value)


def test_depth_maps_of_too_many_pixels_are_not_decoded(one_line) -> None:
    with pytest.raises(ImageError) as caught:
        load_depth_png(depth_png(DEPTH16), max_megapixels=599e-6)
    assert "the depth map has 30x20 pixels, which is over" in one_line(caught.value)
    content = bytearray(depth_png(DEPTH16))
    content[16:24] = (20_000).to_bytes(4, "big") * 2  # in the header
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    with pytest.raises(ImageError, match="20000x20000 pixels"):
        load_depth_png(bytes(content))
