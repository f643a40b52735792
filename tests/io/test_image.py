from __future__ import annotations

import io
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from natsort import natsorted, ns
from PIL import Image, ImageOps

from deepdetect._shared.errors import ImageError, OptionError
from deepdetect.io.image import find_images, load_image, luma
from deepdetect.io.image_file import IMAGE_SUFFIXES

OneLine = Callable[[BaseException], str]

RNG = np.random.default_rng(7)
RGB = RNG.integers(0, 256, (18, 25, 3), dtype=np.uint8)
GREY = RGB[:, :, 0]
ALPHA = RNG.integers(0, 256, (18, 25, 1), dtype=np.uint8)
CUT_OUT = np.rint(
    np.where(ALPHA < 127.5, 128, RGB * (ALPHA / 255) + 128 * (1 - ALPHA / 255))
).astype(np.uint8)
OPAQUE = np.full((18, 25, 1), 255, np.uint8)
DEEP = RNG.integers(0, 65536, (18, 25), dtype=np.uint16)
DEEP_RGB = RNG.integers(0, 65536, (18, 25, 3), dtype=np.uint16)


def triple(grey: np.ndarray) -> np.ndarray:
    return np.stack([grey] * 3, axis=2)


def shallow(deep: np.ndarray) -> np.ndarray:
    """The 8-bit level nearest to a 16-bit one, in exact decimal arithmetic."""
    return np.floor(deep.astype(np.float64) * 255 / 65535 + 0.5).astype(np.uint8)


ARRAYS = {
    "rgb": (RGB, RGB),
    "grey": (GREY, triple(GREY)),
    "rgba": (np.dstack([RGB, ALPHA]), CUT_OUT),
    "opaque": (np.dstack([RGB, OPAQUE]), RGB),
    "fortran order": (np.asfortranarray(RGB), RGB),
    "uint16 grey": (DEEP, triple(shallow(DEEP))),
    "uint16 rgb": (DEEP_RGB, shallow(DEEP_RGB)),
    "uint16 of the other byte order": (
        DEEP.astype(DEEP.dtype.newbyteorder()),
        triple(shallow(DEEP)),
    ),
    "uint16 full range": (
        np.repeat(np.array([[0, 65535]], np.uint16), 16, 0).repeat(8, 1),
        triple(np.repeat(np.array([[0, 255]], np.uint8), 16, 0).repeat(8, 1)),
    ),
    "float32 grey": ((GREY / 255).astype(np.float32), triple(GREY)),
    "float64 rgb": (RGB / 255, RGB),
    "float16 rgba": ((np.dstack([RGB, OPAQUE]) / 255).astype(np.float16), RGB),
    "float a little below a level": ((GREY - 0.4).clip(0) / 255, triple(GREY)),
    "float a little above a level": ((GREY + 0.4).clip(0, 255) / 255, triple(GREY)),
    "bool grey": (GREY > 99, triple(np.where(GREY > 99, 255, 0))),
    "nested lists": ((GREY / 255).tolist(), triple(GREY)),
}


@pytest.mark.parametrize("kind", ARRAYS)
def test_arrays(kind: str) -> None:
    given, expected = ARRAYS[kind]
    before = np.array(given)
    loaded = load_image(given)
    np.testing.assert_array_equal(given, before)
    assert loaded.dtype == np.uint8
    assert loaded.flags.c_contiguous
    np.testing.assert_array_equal(loaded, expected)


DEEP_GREY = triple(shallow(DEEP))
PALETTE = Image.fromarray(RGB).quantize(16)
PIL_IMAGES = {
    "RGB": (Image.fromarray(RGB), RGB),
    "L": (Image.fromarray(GREY), triple(GREY)),
    "RGBA": (Image.fromarray(np.dstack([RGB, ALPHA])), CUT_OUT),
    "LA": (Image.fromarray(np.dstack([GREY, OPAQUE])), triple(GREY)),
    "P": (PALETTE, np.array(PALETTE.getpalette(), np.uint8).reshape(-1, 3)[np.asarray(PALETTE)]),
    "1": (Image.fromarray(GREY > 99), triple(np.where(GREY > 99, 255, 0))),
    "La": (Image.fromarray(np.dstack([GREY, OPAQUE])).convert("La"), triple(GREY)),
    "RGBa": (Image.fromarray(np.dstack([RGB, OPAQUE])).convert("RGBa"), RGB),
    "RGBX": (Image.fromarray(RGB).convert("RGBX"), RGB),
    "PA": (Image.fromarray(np.dstack([GREY, ALPHA])).convert("PA"), triple(GREY)),
    "I;16": (Image.fromarray(DEEP), DEEP_GREY),
    "I;16B": (Image.frombytes("I;16B", (25, 18), DEEP.astype(">u2").tobytes()), DEEP_GREY),
    "F": (Image.fromarray((GREY / 255).astype(np.float32)), triple(GREY)),
}


NO_PNG = ("I;16B", "F", "La", "RGBa", "RGBX", "PA")


@pytest.mark.parametrize("mode", PIL_IMAGES)
def test_pil_images(mode: str) -> None:
    given, expected = PIL_IMAGES[mode]
    assert given.mode == mode
    loaded = load_image(given)
    assert loaded.dtype == np.uint8
    np.testing.assert_array_equal(loaded, expected)


@pytest.mark.parametrize("mode", [mode for mode in PIL_IMAGES if mode not in NO_PNG])
def test_files(mode: str, tmp_path: Path) -> None:
    given, expected = PIL_IMAGES[mode]
    path = tmp_path / "image.png"
    given.save(path)
    np.testing.assert_array_equal(load_image(str(path)), expected)


@pytest.mark.parametrize(
    ("suffix", "exact"),
    [(".bmp", True), (".ppm", True), (".tif", True), (".jpg", False), (".webp", False)],
)
def test_file_formats(suffix: str, exact: bool, photo: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / f"image{suffix}"
    Image.fromarray(photo).save(path)
    loaded = load_image(path)
    difference = np.abs(loaded.astype(int) - photo)
    assert loaded.shape == photo.shape
    assert difference.max() == 0 if exact else difference.mean() < 6


def test_palette_with_transparency_loads_in_silence(tmp_path: Path) -> None:
    # Pillow warns about such files, which are common; a warning is an error in these tests.
    path = tmp_path / "palette.png"
    PALETTE.save(path, transparency=bytes([0] * 4 + [255] * 12))
    expected = np.where(np.asarray(PALETTE)[..., None] < 4, 128, PIL_IMAGES["P"][1])
    np.testing.assert_array_equal(load_image(path), expected)


UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: np.rot90(a, -1),
    7: lambda a: a.swapaxes(0, 1)[::-1, ::-1],
    8: lambda a: np.rot90(a),
}


@pytest.mark.parametrize("orientation", UPRIGHT)
def test_exif_orientation(orientation: int, tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    image, expected = PIL_IMAGES["RGB"]
    image.save(tmp_path / "turned.png", exif=exif)
    loaded = load_image(tmp_path / "turned.png")
    np.testing.assert_array_equal(loaded, UPRIGHT[orientation](expected))


@pytest.mark.parametrize("orientation", UPRIGHT)
@pytest.mark.parametrize("kind", ["RGB", "I;16", "F"])
def test_tiff_orientation(orientation: int, kind: str, tmp_path: Path) -> None:
    # Pillow turns TIFF itself, and scrambles what it maps into memory; once must be enough.
    path = tmp_path / "turned.tif"
    image, expected = PIL_IMAGES[kind]
    for compression in (None, "tiff_lzw"):
        image.save(path, tiffinfo={0x0112: orientation}, compression=compression)
        upright = UPRIGHT[orientation](expected)
        np.testing.assert_array_equal(load_image(path), upright)
        np.testing.assert_array_equal(load_image(path.read_bytes()), upright)


def tiff(array: np.ndarray) -> bytes:
    """Return an uncompressed TIFF file of one band of integers."""
    height, width = array.shape
    bits, sample_format = 8 * array.dtype.itemsize, 2 if array.dtype.kind == "i" else 1
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: 1, 273: 8, 277: 1, 278: height}
    tags |= {279: array.nbytes, 339: sample_format}
    directory = b"".join(struct.pack("<HHIHxx", tag, 3, 1, tags[tag]) for tag in tags)
    header = b"II*\0" + struct.pack("<I", 8 + array.nbytes)
    return header + array.tobytes() + struct.pack("<H", len(tags)) + directory + bytes(4)


@pytest.mark.parametrize("kind", ["u1", "<u2", "i1", "<i2", "<i4", "<u4"])
def test_integer_tiff_has_the_types_of_arrays(kind: str) -> None:
    values = {"u1": GREY, "<u2": DEEP}.get(kind, GREY // 2).astype(kind)
    if kind in ("u1", "<u2"):
        np.testing.assert_array_equal(load_image(tiff(values)), load_image(values))
        return
    with pytest.raises(ImageError):
        load_image(tiff(values))


@pytest.mark.parametrize("kind", ["PNG", "PPM"])
@pytest.mark.parametrize("opened", [True, False])
def test_16_bit_grey_that_pillow_may_hold_in_32_bits(kind: str, opened: bool) -> None:
    file = io.BytesIO(b"P5 25 18 65535\n" + DEEP.astype(">u2").tobytes())
    if kind == "PNG":
        file = io.BytesIO()
        Image.fromarray(DEEP).save(file, kind)
    given = Image.open(file) if opened else file.getvalue()
    np.testing.assert_array_equal(load_image(given), DEEP_GREY)


@pytest.mark.parametrize("opened", [True, False])
@pytest.mark.parametrize(("largest", "bits"), [(1023, 10), (4095, 12), (1000, 16)])
def test_white_of_a_pgm_file_is_its_largest_value(opened: bool, largest: int, bits: int) -> None:
    """Although no pixel is near to it."""
    values = DEEP.astype(int) % (largest // 5)
    file = io.BytesIO(b"P5 25 18 %d\n" % largest + values.astype(">u2").tobytes())
    loaded = load_image(Image.open(file) if opened else file.getvalue())
    np.testing.assert_allclose(loaded, triple(values * 255 / largest), atol=0.51)


def with_value(value: float) -> np.ndarray:
    array = np.full((20, 20), 0.5)
    array[3, 4] = value
    return array


BAD_ARRAYS = {
    "too narrow": np.zeros((16, 15), np.uint8),
    "no pixel": np.zeros((0, 0)),
    "NaN": with_value(np.nan),
    "infinite": with_value(np.inf),
    "above 1": with_value(1.01),
    "below 0": with_value(-0.01),
    "int64": np.zeros((20, 20), np.int64),
    "words": np.full((20, 20), "a"),
    "empty": np.zeros((0, 20), np.uint8),
    "empty with alpha": np.zeros((0, 20, 4), np.uint16),
    "nothing": None,
    "a number": 5,
}


@pytest.mark.parametrize("kind", BAD_ARRAYS)
def test_bad_arrays(kind: str) -> None:
    with pytest.raises(ImageError):
        load_image(BAD_ARRAYS[kind])


@pytest.mark.parametrize("name", ["value_range", "bands"])
def test_tables_in_place_of_numbers_are_refused(name: str) -> None:
    for table in (np.ones((2, 2)), np.ones((3, 2, 2)), [[1, 2], 3]):
        with pytest.raises(OptionError, match=f"`{name}`"):
            load_image(np.zeros((20, 20), np.uint8), **{name: table})


@pytest.mark.parametrize("bits", [12, 16])
def test_colours_of_16_bits_in_jpeg_2000(bits: int) -> None:
    values = np.random.default_rng(0).integers(0, 1 << bits, (40, 50, 3)).astype(np.uint16)
    done, content = cv2.imencode(".jp2", values, [cv2.IMWRITE_JPEG2000_COMPRESSION_X1000, 1000])
    assert done
    rgb = load_image(content.tobytes())
    expected = values[..., ::-1] * (255 / (2**bits - 1))
    assert np.abs(rgb - expected).max() < 4


def test_luma_is_bt601(photo: np.ndarray) -> None:
    exact = photo @ np.array([0.299, 0.587, 0.114])
    assert np.abs(luma(photo) - exact).max() < 0.51


def test_find_images(tmp_path: Path) -> None:
    wanted = natsorted((f"a{suffix}" for suffix in IMAGE_SUFFIXES), alg=ns.PATH)
    wanted += ["b/2.PNG", "b/10.png", "b/c/deep.jpg"]
    others = ["notes.txt", "no_suffix", ".hidden.png", ".cache/thumb.png", "b/.c/thumb.jpg"]
    for name in wanted + others:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    assert find_images(str(tmp_path)) == [tmp_path / name for name in wanted]
    below = find_images(tmp_path, [tmp_path / "b"])
    assert below == [tmp_path / name for name in wanted if not name.startswith("b/")]


def test_broken_exif_is_no_broken_picture(tmp_path: Path) -> None:
    """A signed resolution cannot be rewritten by Pillow; the picture can be read all the same."""
    entries = struct.pack("<HHIHxx", 0x0112, 3, 1, 6) + struct.pack("<HHII", 0x011A, 10, 1, 38)
    exif = b"Exif\0\0II*\0" + struct.pack("<IH", 8, 2) + entries + struct.pack("<Iii", 0, -1, 0)
    path = tmp_path / "photo.jpg"
    Image.new("RGB", (30, 20)).save(path, exif=exif)
    with Image.open(path) as opened, pytest.raises((struct.error, ZeroDivisionError)):
        ImageOps.exif_transpose(opened)
    assert load_image(path).shape == (30, 20, 3)
