from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from deepdetect._shared.errors import ImageError
from deepdetect.io.image import load_image
from deepdetect.io.image_file import read_with, reading_options
from deepdetect.io.masks import load_mask, save_mask

MASK = np.random.default_rng(3).random((19, 26)) > 0.6


@given(arrays(bool, st.tuples(st.integers(1, 20), st.integers(1, 20))))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, mask: np.ndarray) -> None:
    path = tmp_path_factory.getbasetemp() / "round_trip.png"
    save_mask(mask, path)
    with Image.open(path) as opened:
        assert opened.mode == "1"
        assert opened.format == "PNG"
        assert opened.size == mask.shape[::-1]
    loaded = load_mask(path)
    assert loaded.dtype == bool
    np.testing.assert_array_equal(loaded, mask)
    # Another reader sees 0 and 255.
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), mask * 255)


DEPTHS = {
    "8 bits": (np.array([[0, 1, 127, 128, 254, 255]], np.uint8), [0, 0, 0, 1, 1, 1]),
    "16 bits": (np.array([[0, 255, 300, 32767, 32768, 65535]], np.uint16), [0, 0, 0, 0, 1, 1]),
    "bool": (np.array([[False, True]]), [0, 1]),
    "rgb": (np.array([[[0] * 3, [255] * 3, [100] * 3]], np.uint8), [0, 1, 0]),
}


@pytest.mark.parametrize("depth", DEPTHS)
def test_brighter_than_half_at_any_bit_depth(depth: str, tmp_path: Path) -> None:
    values, expected = DEPTHS[depth]
    Image.fromarray(values).save(tmp_path / "mask.png")
    assert load_mask(tmp_path / "mask.png").astype(int).tolist() == [expected]


def test_a_palette_of_two_colours(tmp_path: Path) -> None:
    image = Image.fromarray(MASK.astype(np.uint8)).convert("P")
    image.putpalette([255, 255, 255, 0, 0, 0])  # 0 is white
    image.save(tmp_path / "mask.png")
    np.testing.assert_array_equal(load_mask(tmp_path / "mask.png"), ~MASK)


def test_masks_of_too_many_pixels_are_not_decoded(tmp_path: Path) -> None:
    path = tmp_path / "mask.png"
    save_mask(np.zeros((20, 30), bool), path)
    for source in (path, path.read_bytes(), io.BytesIO(path.read_bytes())):
        with pytest.raises(ImageError), read_with(reading_options(max_megapixels=599e-6)):
            load_mask(source)
        with read_with(reading_options(max_megapixels=600e-6)):
            assert load_mask(source).shape == (20, 30)
    content = bytearray(path.read_bytes())
    content[16:24] = (20_000).to_bytes(4, "big") * 2  # in the header
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    path.write_bytes(content)
    with pytest.raises(ImageError, match="20000x20000"):
        load_mask(path)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_masks_are_turned_as_their_photographs_are(orientation: int, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(MASK).save(tmp_path / "mask.png", exif=exif)
    Image.fromarray(np.dstack([MASK.astype(np.uint8) * 255] * 3)).save(
        tmp_path / "photo.png", exif=exif
    )
    upright = load_image(tmp_path / "photo.png")[..., 0] > 127
    np.testing.assert_array_equal(load_mask(tmp_path / "mask.png"), upright)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_broken_exif_is_no_broken_mask(suffix: str, tmp_path: Path) -> None:
    """A signed resolution cannot be rewritten by Pillow; the mask can be read all the same."""
    entries = struct.pack("<HHIHxx", 0x0112, 3, 1, 6) + struct.pack("<HHII", 0x011A, 10, 1, 38)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 2) + entries + struct.pack("<Iii", 0, -1, 0)
    Image.new("L", (30, 20), 255).save(tmp_path / f"mask{suffix}", exif=exif)
    mask = load_mask(tmp_path / f"mask{suffix}")
    assert mask.shape == load_image(tmp_path / f"mask{suffix}").shape[:2]
    assert mask.all()


@pytest.mark.parametrize("white", [1, 255, 65535, 100_000, 2**31 - 1])
@pytest.mark.parametrize("kind", [np.uint16, np.int32])
def test_white_of_8_bits_in_files_of_more(white: int, kind: type, tmp_path: Path) -> None:
    white = min(white, np.iinfo(kind).max)
    Image.fromarray((MASK * white).astype(kind)).save(tmp_path / "mask.tif")
    np.testing.assert_array_equal(load_mask(tmp_path / "mask.tif"), MASK)
    Image.fromarray(np.zeros(MASK.shape, kind)).save(tmp_path / "mask.tif")
    assert not load_mask(tmp_path / "mask.tif").any()
