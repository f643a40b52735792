"""Image files: kinds of sources, limits, damage, and formats that need a package."""

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
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import EpsImagePlugin, Image
from PIL.PngImagePlugin import PngInfo

from deepdetect._shared.errors import ImageError, MissingExtraError, OptionError
from deepdetect.io.image import load_image, luma
from deepdetect.io.image_file import read_with, reading_options

OneLine = Callable[[BaseException], str]

RNG = np.random.default_rng(7)
RGB = RNG.integers(0, 256, (18, 25, 3), dtype=np.uint8)


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
from deepdetect.io.image import load_image, luma
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
    assert np.abs(turned.astype(int) - np.rot90(photo, -1)).mean() < 6


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


@pytest.mark.parametrize("suffix", [".avi", ".mp4", ".mov", ".mkv", ".mpg", ".ts", ".webm"])
def test_a_video_is_called_a_video(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"clip{suffix}"
    codes = {".avi": "MJPG", ".mpg": "MPEG", ".ts": "mpg2", ".webm": "VP80"}
    code = cv2.VideoWriter_fourcc(*codes.get(suffix, "mp4v"))
    writer = cv2.VideoWriter(str(path), cv2.CAP_ANY, code, 25, (64, 64))
    if not writer.isOpened():
        pytest.skip("the installed OpenCV does not write it")
    for k in range(3):
        writer.write(np.full((64, 64, 3), 60 * k, np.uint8))
    writer.release()
    for source in (path, path.read_bytes()):
        with pytest.raises(ImageError, match="video"):
            load_image(source)


@pytest.mark.parametrize("start", [b"\xff\n", b"\0\0\0\x0cJXL \r\n\x87\n"])
def test_jpeg_xl_is_read_by_a_plug_in_or_refused_by_its_name(
    start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pillow_jxl", None)
    with pytest.raises(MissingExtraError, match="pillow-jxl-plugin"):
        load_image(start + bytes(200))
    plugin = ModuleType("pillow_jxl")
    monkeypatch.setitem(sys.modules, "pillow_jxl", plugin)
    Image.init()
    red = lambda *_: Image.new("RGB", (20, 16), "red")  # noqa: E731
    monkeypatch.setitem(Image.OPEN, "JXL", (red, lambda begins: begins.startswith(start)))
    assert load_image(start + bytes(200))[0, 0].tolist() == [255, 0, 0]


def test_jpeg_of_12_bits_is_refused_with_what_reads_it() -> None:
    imagecodecs = pytest.importorskip("imagecodecs")
    values = np.tile(np.linspace(0, 4095, 64).astype(np.uint16), (32, 1))
    content = imagecodecs.jpeg8_encode(values, bitspersample=12)
    with pytest.raises(ImageError, match="imagecodecs"):
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
