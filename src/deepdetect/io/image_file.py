"""Opening image files of any kind: known formats, the size limit, and checks for damage."""

from __future__ import annotations

import functools
import importlib
import io
import math
import os
import re
import stat
import struct
import sys
import warnings
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, replace
from numbers import Integral, Real
from typing import Any, BinaryIO

import numpy as np

from .._shared.errors import (
    DeepDetectError,
    ImageError,
    MissingExtraError,
    MissingImageError,
    OptionError,
    first_line,
)
from .._shared.machine import temporarily
from .._shared.options import shown, suggest_keywords, whole
from .._shared.value_range import ValueRange

FORMATS = {
    "JPEG": ".jpg .jpeg .jpe .jfif .jfi .jif .mpo .jps .insp",
    "PNG": ".png .apng .pns",
    "TIFF": ".tif .tiff .btf .tf2 .tf8 .gtiff .ptif .svs .ndpi .scn .qptiff .bif .lsm",
    "WEBP": ".webp",
    "BMP": ".bmp",
    "DIB": ".dib",
    "GIF": ".gif",
    "PPM": ".ppm .pgm .pbm .pnm",
    "JPEG2000": ".jp2 .j2k .jpx .jpf .j2c .jpc",
    "AVIF": ".avif",
    "PSD": ".psd",
    "QOI": ".qoi",
    "SGI": ".sgi",
    "PCX": ".pcx",
    "HEIF": ".heic .heif .hif",  # if a plug-in of Pillow registers it
    "JXL": ".jxl",  # if a plug-in registers it
    "TGA": ".tga",  # has no signature, so it comes last
}
"""Formats that are read, with their suffixes. EPS is not read, since it would start Ghostscript."""

_RAW = ".dng .cr2 .cr3 .crw .nef .nrw .arw .sr2 .srf .raf .orf .rw2 .pef .srw .3fr .iiq .erf"
RAW_SUFFIXES = tuple(f"{_RAW} .mrw .kdc .dcr .mos .mef .x3f .rwl".split())
"""Suffixes of raw photographs, which rawpy develops."""

UNREAD = {
    b"v/1\x01": ("an OpenEXR image", ".exr"),
    b"#?R": ("a Radiance HDR image", ".hdr"),
    b"SIMPLE  =": ("a FITS image", ".fits .fit"),
    b"\x93NUMPY": ("a NumPy array", ""),
    b"DICM": ("a DICOM image", ".dcm"),
}
"""Signatures, names and suffixes of formats rejected because their value range is undefined."""

_OTHERS = (suffixes for _, suffixes in UNREAD.values())
IMAGE_SUFFIXES = (*" ".join([*FORMATS.values(), *_OTHERS]).split(), *RAW_SUFFIXES)
"""Suffixes of image files that are read or rejected with a reason."""

MAX_MEGAPIXELS = 200.0
"""Images with more megapixels are rejected by default. The largest phone sensors have 200."""

SIGNATURE_BYTES = 262
"""Formats are recognised by this many first bytes. The signature of DICOM is at bytes 128 to 131,
that of tar starts at byte 257, and that of an MPEG transport stream is in its first two packets."""

STANDARD_INPUT = "/dev/stdin"
"""This path means standard input on every system. For commands, "-" does so as well."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

PLUGINS = {
    "pillow-heif": (rb"(?s).{4}ftyp(hei[cxms]|mif1|msf1)", "pillow_heif.HeifImagePlugin", "HEIF"),
    "pillow-jxl-plugin": (rb"\xff\n|\0{3}\x0cJXL ", "pillow_jxl", "JPEG XL"),
}
"""Plug-ins of Pillow: first bytes of the plug-in's format (ISO/IEC 23008-12, 18181-2), the module
whose import registers this format, and the format's name."""

VIDEO = (
    rb"(?s)\x1aE\xdf\xa3|.{8}AVI |0&\xb2u|FLV|OggS|\0\0\x01[\xb3\xba]|\0\0\0\x01|\x06\x0e\+4"
    rb"|\x1f\x07\0|DKIF|YUV4MPEG2|.{4}(ftyp|moov|mdat|wide|skip|free)|G.{187}G|.{4}G.{191}G"
)
"""First bytes of Matroska, AVI, WMV, FLV, Ogg, MPEG-1 and 2, H.264 and H.265, MXF, DV, IVF,
YUV4MPEG, MP4 and MOV, and of MPEG transport streams, whose packets have 188 or 192 bytes."""

OTHERS = {
    rb"(?s)PK\x03\x04|7z\xbc\xaf|Rar!|\x1f\x8b|BZh|\xfd7zXZ|.{257}ustar": (
        "an archive: unpack it, and give the folder"
    ),
    rb"%PDF": 'a PDF file: draw its pages, as pdftoppm -r 200 -png "{0}" page does, and give these',
    rb"(?!#EXTM3U)[^\0-\x08\x0e-\x1a\x1c-\x1f]{4,}\Z": (
        "text, not an image or video: give such files, or their folder"
    ),
}
"""First bytes of files that are neither images nor videos, what such a file is, and what to do.
Playlists of videos, which are text that begins with #EXTM3U, are excepted: OpenCV reads them."""


@suggest_keywords
@dataclass(frozen=True)
class ReadingOptions:
    """How image files are read; the fields other than the last two are parameters of `load_image`.

    `deep_range` is the common value range of those uint16 images of a call whose files state none.
    While this range is being found, the histograms of these images are summed in `counts`.
    """

    max_megapixels: float = MAX_MEGAPIXELS
    value_range: ValueRange | None = None
    bands: tuple[int, int, int] | None = None
    page: int | None = None
    allow_truncated: bool = False
    deep_range: ValueRange | None = None
    counts: np.ndarray | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.max_megapixels, Real) and self.max_megapixels > 0):
            raise OptionError(f"`max_megapixels` must be above 0, not {self.max_megapixels}")
        if self.page is not None:
            whole("page", self.page)
        for name, count, kind, what in (
            ("bands", 3, Integral, "3 numbers from 1 on"),
            ("value_range", 2, Real, "2 numbers, black and a larger white"),
        ):
            value = getattr(self, name)
            numbers: tuple[Any, ...] = tuple(value) if np.iterable(value) else ()
            fits = len(numbers) == count and all(isinstance(each, kind) for each in numbers)
            if fits:
                fits = 0 < (min(numbers) if count == 3 else numbers[1] - numbers[0]) < math.inf
            if value is not None and not fits:
                raise OptionError(f"`{name}` must be {what}, not {shown(value)}")
            object.__setattr__(self, name, numbers or None)

    @property
    def common(self) -> dict[str, Any]:
        """Arguments of `array_to_pixels` for the value range that all images of a call share."""
        return {"call": self.deep_range, "counts": self.counts}

    @property
    def settings(self) -> dict[str, Any]:
        """The options that change pixels and differ from their defaults."""
        values = {**vars(self), "max_megapixels": None}
        return {name: value for name, value in values.items() if value not in (None, False)}

    def check_size(self, name: str, size: tuple[int, int]) -> None:
        """Raise an ImageError if an image of this (width, height) exceeds `max_megapixels`."""
        width, height = size
        if width * height > 1e6 * self.max_megapixels:
            raise ImageError(
                f"{name} has {width}x{height} pixels, which is over {self.max_megapixels:g} "
                "megapixels: make it smaller, or raise `max_megapixels`"
            )


_USUAL = ReadingOptions()
_reading: ContextVar[ReadingOptions] = ContextVar("reading", default=_USUAL)


@contextmanager
def read_with(options: ReadingOptions) -> Iterator[None]:
    """Read image files with these options in the block, unless a call has options of its own.

    Commands use this for all images that they read. Other processes are not affected.
    """
    token = _reading.set(options)
    try:
        yield
    finally:
        _reading.reset(token)


def reading_options(**given: Any) -> ReadingOptions:
    """Return the options set by `read_with`, overridden by the given values that are not None."""
    return replace(_reading.get(), **{n: value for n, value in given.items() if value is not None})


@contextmanager
def open_image(
    source: Any, *, what: str = "image", options: ReadingOptions | None = None
) -> Iterator[Any]:
    """Open an image file as a PIL image; its pixels are decoded when it is loaded.

    The source is a path, the content of a file as bytes, or a binary file, which is read from its
    beginning and stays open. Pillow's errors in the block are raised as the errors below. In
    messages, an image without a path is called "the" and `what`, such as "the mask".

    Raises:
        ImageError: the file is missing, truncated, damaged (where the format allows to detect it),
            larger than `max_megapixels`, or not an image.
        MissingExtraError: it is a HEIF or raw image, and the package for it is not installed.
    """
    from PIL import ImageFile

    options = options or reading_options()
    with open_file(source, what) as (file, name):
        if not options.allow_truncated:
            _check_png(file, name)
        with identify(file, name) as image:
            options.check_size(name, image.size)
            if options.page:
                if options.page >= (pages := getattr(image, "n_frames", 1)):
                    raise ImageError(f"{name} has {pages} pages: give a `page` below that")
                image.seek(options.page)
            # Pillow has one such setting for all threads.
            allowed = ImageFile.LOAD_TRUNCATED_IMAGES or options.allow_truncated
            with temporarily(ImageFile, LOAD_TRUNCATED_IMAGES=allowed):
                yield image


@contextmanager
def open_file(source: Any, what: str = "image") -> Iterator[tuple[BinaryIO, str]]:
    """Open a source of `open_image` as a binary file; yield it and its name for errors.

    Errors that Pillow raises in the block become an `ImageError`.
    """
    name = file_name(source, what)
    try:
        with _binary_file(source, name) as file:
            yield file, name
    except DeepDetectError:
        raise
    except FileNotFoundError:
        raise MissingImageError(f"there is no file {name}: check the path") from None
    except OSError as error:
        if error.errno is None:  # an error of Pillow, not of the file system
            raise damaged_image(name, error) from None
        raise ImageError(f"{name} cannot be read ({error.strerror}): check the path") from None
    except Exception as error:  # Pillow's decoders raise many types of errors
        raise damaged_image(name, error) from None


def file_name(source: Any, what: str = "image") -> str:
    """Return the name of a file for errors: its path if it has one, otherwise "the" and `what`."""
    if is_path(source):
        return os.fsdecode(source)
    name = getattr(source, "name", None)
    return name if isinstance(name, str) and hasattr(source, "read") else f"the {what}"


def is_path(source: Any) -> bool:
    """Return whether the source is a path: text or any `os.PathLike`."""
    return isinstance(source, (str, os.PathLike))


def is_file(source: Any) -> bool:
    """Return whether `open_image` accepts the source: a path, bytes or an open file."""
    return is_path(source) or isinstance(source, (bytes, bytearray)) or hasattr(source, "read")


def damaged_image(name: str, error: Exception | str) -> ImageError:
    """Return the error for a file that cannot be decoded."""
    from PIL import Image

    if isinstance(error, Image.DecompressionBombError):  # some decoders have their own limit
        limit = 2e-6 * (Image.MAX_IMAGE_PIXELS or 0)
        return ImageError(
            f"{name} has more than {limit:.0f} megapixels, Pillow's limit for its format: save it "
            "as PNG or JPEG, or raise PIL.Image.MAX_IMAGE_PIXELS"
        )
    if isinstance(error, MemoryError):
        return ImageError(f"there is not enough memory to read {name}: use a smaller image")
    return ImageError(f"{name} is damaged or truncated ({first_line(error)}): get it again")


@contextmanager
def _binary_file(source: Any, name: str) -> Iterator[BinaryIO]:
    """Open a path or bytes; rewind an open file, or copy it to memory if it cannot be rewound."""
    if isinstance(source, (bytes, bytearray)):
        yield io.BytesIO(source)
    elif name == STANDARD_INPUT:
        yield io.BytesIO(_standard_input())
    elif is_path(source):
        mode = os.stat(source).st_mode
        pipe = stat.S_ISFIFO(mode) and name.startswith("/dev/fd/")  # from a shell's <(...)
        if stat.S_ISDIR(mode):
            raise ImageError(f"{name} is a folder: give an image file in it")
        if not (stat.S_ISREG(mode) or pipe):
            raise ImageError(f"{name} is a pipe or a device: save the image as a file first")
        # Given a path, Pillow maps uncompressed TIFF into memory and turns it the wrong way.
        with open(os.fspath(source), "rb") as file:
            yield io.BytesIO(file.read()) if pipe else file
    else:
        if getattr(source, "closed", False) or isinstance(source, io.TextIOBase):
            raise ImageError(f'{name} is not an open binary file: open it with the mode "rb"')
        try:
            source.seek(0)
        except (AttributeError, OSError):
            source = io.BytesIO(source.read())
        yield source


@functools.cache
def _standard_input() -> bytes:
    """Return the content of standard input; it is cached because it can be read only once."""
    if sys.stdin is None:
        raise ImageError("there is no standard input: give the file")
    return sys.stdin.buffer.read()


def _check_png(file: BinaryIO, name: str) -> None:
    """If the file is a PNG file, verify its checksums, because Pillow skips those of the pixels."""
    if file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
        kind = b""
        while kind != b"IEND":
            header = file.read(8)
            left, kind = int.from_bytes(header[:4], "big"), header[4:]
            checksum = zlib.crc32(kind)
            # Read in pieces, because a damaged file may state a length of 4 GB.
            while left and (piece := file.read(min(left, 1 << 20))):
                checksum = zlib.crc32(piece, checksum)
                left -= len(piece)
            if file.read(4) != checksum.to_bytes(4, "big"):
                raise damaged_image(name, "a checksum of the PNG file is wrong or missing")
    file.seek(0)


def identify(file: BinaryIO, name: str, formats: Iterable[str] = FORMATS) -> Any:
    """Open a file with the first of `formats` (keys of `FORMATS`) whose reader accepts it.

    `PIL.Image.open` is not used, because its size limit can only be set for the whole program.
    """
    from PIL import Image

    _hide_warning_of_large_images()
    Image.init()  # registers the formats of this build of Pillow; some lack AVIF
    file.seek(0)
    start = file.read(SIGNATURE_BYTES)
    plugin = next((key for key, (begins, *_) in PLUGINS.items() if re.match(begins, start)), None)
    if plugin:
        with suppress(ModuleNotFoundError):
            importlib.import_module(PLUGINS[plugin][1])
    for beginning, (what, _) in UNREAD.items():
        if beginning in (start[: len(beginning)], start[128:132]):
            raise ImageError(
                f"{name} is {what}, which has no defined value range: load it with another "
                "program, and give an array or a PNG file"
            )
    if name.lower().endswith(RAW_SUFFIXES):
        return develop(file, name)
    for key in formats:
        if key not in Image.OPEN:
            continue
        factory, accept = Image.OPEN[key]
        try:
            accepted = accept is None or accept(start)
            if accepted and not isinstance(accepted, str):  # a string names a missing library
                file.seek(0)
                return factory(file, "")
        except (SyntaxError, IndexError, TypeError, struct.error) as error:
            if key == "JPEG" and "-bit" in str(error):
                text = f"{name} is a JPEG image that Pillow does not read ({error})"
                raise ImageError(f"{text}: give the array that imagecodecs reads") from None
    if plugin:
        kind = PLUGINS[plugin][2]
        raise MissingExtraError(f"{name} is a {kind} image: run pip install {plugin} to read it")
    if re.match(VIDEO, start):
        raise ImageError(
            f'{name} is a video: take frames from it, such as by ffmpeg -i "{name}" -vf fps=5 '
            "frames/%05d.jpg (docs/reconstruction.md), and give these"
        )
    refuse_others(start, name)
    raise ImageError(f"{name} is not an image that can be read: use PNG or JPEG")


def refuse_others(start: bytes, name: str) -> None:
    """Raise an ImageError if the first bytes of a file show neither an image nor a video."""
    for begins, what in OTHERS.items():
        if re.match(begins, start) and not re.match(VIDEO, start):
            raise ImageError(f"{name} is {what.format(name)}")


def develop(file: BinaryIO, name: str) -> Any:
    """Develop a raw photograph to an upright PIL image, with the camera's white balance."""
    from PIL import Image

    try:
        import rawpy
    except ModuleNotFoundError:
        raise MissingExtraError(
            f"{name} is a raw photograph: run pip install rawpy to read it, or develop it to JPEG"
        ) from None
    file.seek(0)
    with rawpy.imread(file) as raw:
        return Image.fromarray(raw.postprocess(use_camera_wb=True))


def _hide_warning_of_large_images() -> None:
    """Hide Pillow's warning about images of 89 to 178 megapixels, unless the program filters it."""
    from PIL import Image

    kind = Image.DecompressionBombWarning
    # `warnings.catch_warnings` would not be thread-safe.
    if not any(category is kind for _, _, category, *_ in warnings.filters):
        warnings.filterwarnings("ignore", category=kind, append=True)
