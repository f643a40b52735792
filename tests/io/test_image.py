from __future__ import annotations

import contextlib
import io
import os
import struct
import subprocess
import sys
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from natsort import natsorted, ns
from PIL import EpsImagePlugin, Image, ImageOps
from PIL.PngImagePlugin import PngInfo

from deepdetect._shared.errors import ImageError, MissingExtraError, OptionError
from deepdetect.io.image import find_images, load_image, luma, scale_short_side
from deepdetect.io.image_file import IMAGE_SUFFIXES, read_with, reading_options

OneLine = Callable[[BaseException], str]

RNG = np.random.default_rng(7)
RGB = RNG.integers(0, 256, (18, 25, 3), dtype=np.uint8)
GREY = RGB[:, :, 0]
ALPHA = RNG.integers(0, 256, (18, 25, 1), dtype=np.uint8)
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
    "rgba": (np.dstack([RGB, ALPHA]), RGB),
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
    "float16 rgba": ((np.dstack([RGB, ALPHA]) / 255).astype(np.float16), RGB),
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
    "RGBA": (Image.fromarray(np.dstack([RGB, ALPHA])), RGB),
    "LA": (Image.fromarray(np.dstack([GREY, ALPHA])), triple(GREY)),
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
    PALETTE.save(path, transparency=bytes(range(16)))
    np.testing.assert_array_equal(load_image(path), PIL_IMAGES["P"][1])


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


def encoded(rgb: np.ndarray, kind: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, kind)
    return buffer.getvalue()


PNG = encoded(RGB, "PNG")
JPEG = encoded(RNG.integers(0, 256, (64, 80, 3), dtype=np.uint8), "JPEG")


def write(name: str, content: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_bytes(content)
        return folder / name

    return make


BAD_FILES = {
    "missing": lambda folder: folder / "none.png",
    "folder": lambda folder: folder,
    "text": write("text.png", b"These are words.\n" * 9),
    "empty": write("empty.png", b""),
    "half a PNG": write("half.png", PNG[: len(PNG) // 2]),
    "half a JPEG": write("half.jpg", JPEG[: len(JPEG) // 2]),
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_bad_files(kind: str, tmp_path: Path, one_line: OneLine) -> None:
    path = BAD_FILES[kind](tmp_path)
    with pytest.raises(ImageError) as caught:
        load_image(path)
    assert str(path) in one_line(caught.value)


def test_one_flipped_bit_of_a_png_is_an_error() -> None:
    text = PngInfo()
    text.add_text("before", "the pixels")
    text.add(b"ruNe", b"after the pixels", after_idat=True)  # a chunk that nobody knows
    file = io.BytesIO()
    Image.fromarray(RGB).save(file, "PNG", pnginfo=text)
    content = file.getvalue()
    assert content.index(b"before") < content.index(b"IDAT") < content.index(b"after")
    np.testing.assert_array_equal(load_image(content), RGB)
    signature = 8
    for place in range(signature, len(content)):
        flipped = bytearray(content)
        flipped[place] ^= 1 << place % 8
        with pytest.raises(ImageError):
            load_image(bytes(flipped))


@pytest.mark.skipif(os.name != "posix", reason="the program is a shell script")
def test_a_file_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Pillow has Ghostscript (gs) draw PostScript, whatever the name of the file.
    program, started = tmp_path / "gs", tmp_path / "started"
    program.write_text(f"#!/bin/sh\ntouch '{started}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)  # found by an earlier test
    path = tmp_path / "photo.jpg"
    path.write_bytes(
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 20 20\n%%EndComments\nshowpage\n"
    )
    with Image.open(path) as opened:
        assert opened.format == "EPS"
    with pytest.raises(ImageError):
        load_image(path)
    assert not started.exists()


@pytest.mark.parametrize("kind", ["PNG", "TIFF", "GIF"])
def test_large_images_load_in_silence(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    content = encoded(RGB, kind)
    expected = load_image(content)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 300)  # it has 450; an error comes at 600
    with warnings.catch_warnings(record=True) as caught:
        warnings.resetwarnings()
        np.testing.assert_array_equal(load_image(content), expected)
    assert caught == []


def claims_to_be(width: int, height: int) -> bytes:
    """Return a PNG file of a few bytes whose header states a size."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(kind + content).to_bytes(4, "big")
        return len(content).to_bytes(4, "big") + kind + content + checksum

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = chunk(b"IDAT", zlib.compress(bytes(99)))
    return PNG[:8] + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


@pytest.mark.parametrize("size", [(20_001, 10_000), (2**31 - 1, 2**31 - 1)])
def test_a_file_of_too_many_pixels_is_not_decoded(size: tuple[int, int]) -> None:
    with pytest.raises(ImageError, match=rf"{size[0]}x{size[1]}.*`max_megapixels`"):
        load_image(claims_to_be(*size))


def test_the_limit_of_pixels_is_raised_and_lowered_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)  # Pillow's own, which is for all programs
    np.testing.assert_array_equal(load_image(PNG, max_megapixels=450e-6), RGB)
    with read_with(reading_options(max_megapixels=449e-6)):
        np.testing.assert_array_equal(load_image(PNG, max_megapixels=450e-6), RGB)
        with pytest.raises(ImageError):
            load_image(PNG)
    np.testing.assert_array_equal(load_image(PNG), RGB)
    with pytest.raises(ImageError, match="25x18"):
        load_image(PNG, max_megapixels=449e-6)
    for wrong in (0, -1, float("nan")):
        with pytest.raises(OptionError):
            load_image(PNG, max_megapixels=wrong)


@pytest.mark.skipif(sys.platform == "win32", reason="memory is measured by the module resource")
def test_a_large_image_is_held_once_in_each_form() -> None:
    """The PIL image and the array: 4 bytes for each pixel of a grey image, and no more copies."""
    program = """
import io, resource, sys
import numpy as np
from PIL import Image
from deepdetect.io.image import load_image
file = io.BytesIO()
Image.new("L", (8000, 5000)).save(file, "PNG", compress_level=1)
load_image(np.zeros((16, 16), np.uint8))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
load_image(file)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) * (1 if sys.platform == "darwin" else 1024) / 40e6)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) < 5


class OneWay(io.RawIOBase):
    """Bytes that come once, as from a socket."""

    def __init__(self, content: bytes) -> None:
        self.source = io.BytesIO(content)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        return self.source.readinto(buffer)


OPENED: dict[str, Callable[[Path], Any]] = {
    "PurePath": PurePath,
    "bytearray": lambda path: bytearray(path.read_bytes()),
    "BytesIO": lambda path: io.BytesIO(path.read_bytes()),
    "open file": lambda path: path.open("rb"),
    "unbuffered file": lambda path: path.open("rb", buffering=0),
    "file that cannot go back": lambda path: OneWay(path.read_bytes()),
}


@pytest.mark.parametrize("kind", OPENED)
def test_paths_and_files_of_every_kind(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    path.write_bytes(PNG)
    given = OPENED[kind](path)
    with given if hasattr(given, "close") else contextlib.nullcontext():
        if "open" in kind:
            given.read(5)  # wherever it is
        np.testing.assert_array_equal(load_image(given), RGB)
        assert not getattr(given, "closed", False)
        if "cannot" not in kind:
            np.testing.assert_array_equal(load_image(given), RGB)


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
    "nothing": None,
    "a number": 5,
}


@pytest.mark.parametrize("kind", BAD_ARRAYS)
def test_bad_arrays(kind: str) -> None:
    with pytest.raises(ImageError):
        load_image(BAD_ARRAYS[kind])


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


@given(height=st.integers(16, 300), width=st.integers(16, 300), side=st.integers(16, 300))
def test_the_short_side_is_exact_and_the_shape_is_kept(height: int, width: int, side: int) -> None:
    scaled = scale_short_side(np.zeros((height, width, 3), np.uint8), side)
    assert min(scaled.shape[:2]) == side
    factor = side / min(height, width)
    assert scaled.shape[0] == pytest.approx(height * factor, abs=0.5)
    assert scaled.shape[1] == pytest.approx(width * factor, abs=0.5)


def test_shrinking_averages_areas(photo: np.ndarray) -> None:
    sums = photo.astype(int).reshape(64, 4, 64, 4, 3).sum((1, 3))
    assert np.abs(scale_short_side(photo, 64) - sums / 16).max() <= 0.5


@pytest.fixture
def heic(photo: np.ndarray) -> Callable[..., bytes]:
    """Write HEIC files, as telephones do, without registering the format."""
    pillow_heif = pytest.importorskip("pillow_heif")

    def write(**options: Any) -> bytes:
        file = io.BytesIO()
        data = np.ascontiguousarray(photo)
        image = pillow_heif.from_bytes("RGB", photo.shape[1::-1], data.tobytes())
        image.save(file, quality=95, **options)
        return file.getvalue()

    return write


def test_heic_files_are_read_and_turned_once(heic: Callable[..., bytes], photo: np.ndarray) -> None:
    assert np.abs(load_image(heic()).astype(int) - photo).mean() < 6
    exif = Image.Exif()
    exif[0x0112] = 6
    turned = load_image(heic(exif=exif.tobytes()))
    assert np.abs(turned.astype(int) - UPRIGHT[6](photo)).mean() < 6


def test_without_pillow_heif_its_name_is_said(
    heic: Callable[..., bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    content = heic()
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    Image.init()
    monkeypatch.delitem(Image.OPEN, "HEIF", raising=False)
    with pytest.raises(MissingExtraError, match="pillow-heif"):
        load_image(content)


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (b"v/1\x01" + bytes(200), "OpenEXR"),
        (b"#?RADIANCE\n" + bytes(200), "Radiance"),
        (b"SIMPLE  =                    T" + bytes(200), "FITS"),
        (bytes(128) + b"DICM" + bytes(200), "DICOM"),
        (b"\x93NUMPY" + bytes(200), "NumPy"),
    ],
)
def test_what_is_no_photograph_is_called_what_it_is(content: bytes, name: str) -> None:
    with pytest.raises(ImageError, match=name):
        load_image(content)


@pytest.fixture
def raw_photograph(tmp_path: Path) -> Path:
    """A DNG file of a grey scene, brighter to the right, with a thumbnail before it."""
    tifffile = pytest.importorskip("tifffile")
    mosaic = np.tile(np.linspace(0, 4095, 80).astype(np.uint16), (64, 1))
    tags = [
        *((50706, 1, 4, (1, 4, 0, 0), True), (50708, 2, 0, "Camera", True)),
        *((33421, 3, 2, (2, 2), True), (33422, 1, 4, (0, 1, 1, 2), True)),
        *((50714, 4, 1, 0, True), (50717, 4, 1, 4095, True), (50728, 5, 3, (1,) * 6, True)),
        (50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
    ]
    path = tmp_path / "photo.dng"
    tifffile.imwrite(path, mosaic, photometric="cfa", extratags=tags)
    return path


def test_raw_photographs_are_developed(raw_photograph: Path) -> None:
    pytest.importorskip("rawpy")
    grey = luma(load_image(raw_photograph)).astype(int)
    assert grey.shape == (64, 80)
    assert (np.diff(np.median(grey, axis=0)[2:-2]) >= 0).all()
    assert np.ptp(grey) > 200


def test_without_rawpy_its_name_is_said(
    raw_photograph: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rawpy", None)
    with pytest.raises(MissingExtraError, match="rawpy"):
        load_image(raw_photograph)


def test_bands_of_a_pil_image_are_refused() -> None:
    with pytest.raises(OptionError, match="`bands`"):
        load_image(Image.fromarray(RGB), bands=(3, 2, 1))
