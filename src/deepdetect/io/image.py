"""Reading images of any usual kind as 8-bit RGB or as luma.

Pixel convention everywhere: x right, y down, centre of the first pixel (0, 0).
"""

from __future__ import annotations

import io
import stat
import warnings
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from .._shared.errors import ImageError

MINIMUM_SIDE = 16
"""Smallest width and height of an image, in pixels."""

IMAGE_SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".ppm", ".tif", ".tiff", ".webp")
"""File name suffixes of the images that `find_images` lists."""

FORMATS = (
    *("JPEG", "PNG", "TIFF", "WEBP", "BMP", "DIB", "GIF", "PPM", "JPEG2000", "AVIF"),
    *("PSD", "QOI", "SGI", "PCX"),
    *("HEIF", "JXL"),  # where a plug-in of Pillow has registered them
    "TGA",  # has no signature, so it comes last
)
"""Formats that are read: all are decoded in this process, unlike EPS, which starts Ghostscript."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
SAMPLE_FORMAT, SIGNED = 339, 2  # a tag of TIFF, and its value for signed integers


def load_image(image: Any) -> np.ndarray:
    """Read an image of any usual kind as 8-bit RGB.

    Args:
        image: a path; the content of an image file as bytes; a PIL image; or an array
            (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) in the order RGB(A): uint8, uint16 (full
            range 0..65535) or float in [0, 1]. The alpha channel is dropped. Files, also as
            bytes, are turned upright by their EXIF tag. Pixels of files and PIL images are
            of these types too, signed and 32-bit integers are refused.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        ImageError: the file is missing, truncated, damaged (as far as its format lets one
            see) or no image, the array has a wrong shape, type or range or holds NaN, or a
            side is shorter than 16 pixels.

    Example:
        >>> load_image(np.zeros((20, 30), np.uint16)).shape
        (20, 30, 3)
    """
    if isinstance(image, (str, Path)):
        rgb, name = _read_file(Path(image), str(image)), str(image)
    elif isinstance(image, bytes):
        rgb, name = _read_file(io.BytesIO(image), "the image"), "the image"
    elif hasattr(image, "convert") and hasattr(image, "getbands"):  # a PIL image
        rgb, name = _from_pil(image), "the image"
    else:
        rgb, name = _from_array(image), "the image"
    if min(rgb.shape[:2]) < MINIMUM_SIDE:
        height, width = rgb.shape[:2]
        raise ImageError(
            f"{name} is {width}x{height} pixels: "
            f"both sides must be at least {MINIMUM_SIDE}, use a larger image"
        )
    return rgb


def luma(rgb: np.ndarray) -> np.ndarray:
    """Return the 8-bit luma (ITU-R BT.601) of a (H, W, 3) uint8 RGB image as (H, W) uint8."""
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)


def scale_short_side(rgb: np.ndarray, short_side: int) -> np.ndarray:
    """Scale an image so that its shorter side has the given length in pixels."""
    height, width = rgb.shape[:2]
    factor = short_side / min(height, width)
    if factor == 1:
        return rgb
    size = (max(round(width * factor), short_side), max(round(height * factor), short_side))
    # Area averaging does not alias when shrinking; cubic keeps edges when enlarging.
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return cv2.resize(rgb, size, interpolation=method)


def find_images(folder: str | Path, exclude: Sequence[Path] = ()) -> list[Path]:
    """List the image files below a folder, sorted by path.

    Args:
        folder: the folder.
        exclude: folders below it that are left out, such as the output folder.

    Raises:
        ImageError: the folder is missing, or holds no image.
    """
    root = Path(folder)
    if not root.is_dir():
        raise ImageError(f"there is no folder {root}: check the path")
    left_out = [path.resolve() for path in exclude if path.resolve() != root.resolve()]
    found = sorted(
        path
        for path in root.rglob("*")
        if path.suffix.lower() in IMAGE_SUFFIXES
        and path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(root).parts)
        and not any(path.resolve().is_relative_to(other) for other in left_out)
    )
    if not found:
        raise ImageError(
            f"there is no image in {root}: put files ending in "
            f"{', '.join(suffix[1:] for suffix in IMAGE_SUFFIXES)} there"
        )
    return found


def _read_file(file: Path | io.BytesIO, name: str) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        if isinstance(file, io.BytesIO):
            return _decode(file, name)
        mode = file.stat().st_mode
        if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise ImageError(f"{name} is a pipe or a device: save the image as a file first")
        # Pillow gets no path: it would map uncompressed TIFF into memory, and turn it wrongly.
        with file.open("rb") as opened:
            return _decode(opened, name)
    except FileNotFoundError:
        raise ImageError(f"there is no file {name}: check the path") from None
    except IsADirectoryError:
        raise ImageError(f"{name} is a folder: name an image file") from None
    except UnidentifiedImageError:
        raise ImageError(f"{name} is not an image that can be read: use PNG or JPEG") from None
    except Image.DecompressionBombError:
        raise ImageError(f"{name} has over 178 million pixels: make it smaller") from None
    except PermissionError:
        raise ImageError(f"{name} may not be read: check its rights") from None
    except ImageError:
        raise
    except Exception as error:  # Pillow's decoders raise many kinds
        raise _damaged(name, error) from None


def _decode(file: BinaryIO, name: str) -> np.ndarray:
    from PIL import Image

    _check_png(file, name)
    _hide_warning_of_large_images()
    Image.init()  # registers all formats; that of AVIF is not in every Pillow
    with Image.open(file, formats=[key for key in FORMATS if key in Image.OPEN]) as opened:
        return _from_pil(opened, name, upright=True)


def _check_png(file: BinaryIO, name: str) -> None:
    """Check the checksums of a PNG file, if it is one: Pillow skips those of the pixels."""
    if file.read(len(PNG_SIGNATURE)) == PNG_SIGNATURE:
        kind = b""
        while kind != b"IEND":
            header = file.read(8)
            left, kind = int.from_bytes(header[:4], "big"), header[4:]
            checksum = zlib.crc32(kind)
            # In pieces, as a damaged length may be 4 GB.
            while left and (piece := file.read(min(left, 1 << 20))):
                checksum = zlib.crc32(piece, checksum)
                left -= len(piece)
            if file.read(4) != checksum.to_bytes(4, "big"):
                raise _damaged(name, "a checksum of the PNG file is wrong or missing")
    file.seek(0)


def _hide_warning_of_large_images() -> None:
    """Hide Pillow's warning of 89 to 178 million pixels, unless the program filters it itself."""
    from PIL import Image

    kind = Image.DecompressionBombWarning
    # Not catch_warnings, which is not safe with threads.
    if not any(category is kind for _, _, category, *_ in warnings.filters):
        warnings.filterwarnings("ignore", category=kind, append=True)


def _upright(image: Any) -> Any:
    """Turn a loaded picture upright by its EXIF tag; a broken tag is ignored."""
    from PIL import Image

    if image.format == "TIFF":  # Pillow has turned it when it loaded it
        return image
    try:
        orientation = image.getexif().get(0x0112, 1)
    except Exception:
        return image
    turns = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_270,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_90,
    }
    return image.transpose(turns[orientation]) if orientation in turns else image


def _damaged(name: str, error: Exception | str) -> ImageError:
    return ImageError(f"{name} is damaged or truncated ({error}): get it again")


def _from_pil(image: Any, name: str = "the image", *, upright: bool = False) -> np.ndarray:
    try:
        image.load()
    except Exception as error:  # Pillow's decoders raise many kinds
        raise _damaged(name, error) from None
    # Pillow holds 16-bit PGM, and 10.3 also 16-bit PNG, in 32 bits; all else may have any range.
    wide = image.mode == "I" and image.format not in ("PNG", "PPM")
    if wide or SIGNED in getattr(image, "tag_v2", {}).get(SAMPLE_FORMAT, ()):
        raise ImageError(
            f"{name} holds 32-bit or signed integers, whose range is not known: convert it "
            "to 8 bits (mode L or RGB), 16 bits without sign (mode I;16) or float in [0, 1]"
        )
    if upright:
        image = _upright(image)
    if image.mode == "P" and isinstance(image.info.get("transparency"), bytes):
        image = image.convert("RGBA")  # Pillow warns when it drops such an alpha at once
    if image.mode == "I":
        return _from_array(np.asarray(image).astype(np.uint16), name)
    if image.mode.startswith("I;16") or image.mode == "F":
        return _from_array(np.asarray(image), name)
    return np.asarray(image.convert("RGB"))


def _from_array(image: Any, name: str = "the image") -> np.ndarray:
    try:
        array = np.asarray(image)
    except ValueError:
        raise ImageError("an image array must have rows of equal length") from None
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if not (array.ndim == 2 or (array.ndim == 3 and array.shape[2] in (3, 4))):
        raise ImageError(
            f"an image array has shape {array.shape}: "
            "it must be (height, width), or (height, width, channels) with 1, 3 or 4 channels"
        )
    values = _to_uint8(array, name)
    if values.ndim == 2:
        return np.repeat(values[:, :, None], 3, axis=2)
    return np.ascontiguousarray(values[:, :, :3])


def _to_uint8(array: np.ndarray, name: str) -> np.ndarray:
    if array.dtype == np.uint8:
        return array
    if array.dtype == np.bool_:
        return array.astype(np.uint8) * 255
    if array.dtype.kind == "u" and array.dtype.itemsize == 2:  # of either byte order
        # Divide by 257 with rounding, so that 65535 becomes 255.
        return ((array.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if np.issubdtype(array.dtype, np.floating):
        if not np.isfinite(array).all():
            raise ImageError(f"{name} holds NaN or infinite values: replace them first")
        if array.size and (array.min() < 0 or array.max() > 1):
            raise ImageError(
                f"a float image must lie in [0, 1], {name} spans "
                f"[{array.min():g}, {array.max():g}]: scale it first"
            )
        return np.rint(array * 255).astype(np.uint8)
    raise ImageError(
        f"an image array of type {array.dtype} is not understood: use uint8, uint16 or float"
    )
