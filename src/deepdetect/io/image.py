"""Reading images from files, bytes, PIL images and arrays, as 8-bit RGB or as luma.

Pixel convention everywhere: x right, y down, centre of the first pixel (0, 0).
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np

from .._shared.alpha import on_grey, opaque_part
from .._shared.errors import ImageError, MissingImageError, OptionError
from .._shared.image_array import Channels, array_to_pixels, check_channels, deep_values
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from .._shared.records import was_made
from .._shared.value_range import find_range
from ..features.selection import check_ignore
from .companions import holds_image, tell_left_out, without_masks
from .image_file import (
    IMAGE_SUFFIXES,
    PNG_SIGNATURE,
    RAW_SUFFIXES,
    SIGNATURE_BYTES,
    ReadingOptions,
    damaged_image,
    file_name,
    is_file,
    is_path,
    open_file,
    open_image,
    read_with,
    reading_options,
)
from .tiff import TIFF_STARTS, page_numbers, read_tiff

Found = TypeVar("Found")
Images = list[Any] | tuple[Any, ...] | np.ndarray
"""Several images: a list, a tuple, or a batch in an array of four dimensions."""

MINIMUM_SIDE = 16
"""Images must be at least this many pixels wide and high. Chosen by hand."""

SEEN_IMAGES = 8
"""The common value range of many 16-bit images is found from this many of them, because reading all
images for it would double the time. Chosen by hand."""

ALL_VALUES = (0, 65535)

ORIENTATION_TAG = 0x0112
GREY_PNG = 0
"""Colour type of a grey PNG image: the value at offset 25 of the file."""

STRIP_PIXELS = 1 << 20
"""PIL images are converted in strips of this many pixels: a whole copy could take gigabytes."""

UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda image: cv2.flip(image, 1),
    3: lambda image: cv2.rotate(image, cv2.ROTATE_180),
    4: lambda image: cv2.flip(image, 0),
    5: lambda image: cv2.transpose(image),
    6: lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    7: lambda image: cv2.flip(cv2.transpose(image), -1),
    8: lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
}
"""Functions that turn an image upright, by the EXIF orientation of the image."""


@suggest_keywords
def load_image(
    image: Any,
    *,
    channels: Channels = "rgb",
    max_megapixels: float | None = None,
    value_range: tuple[float, float] | None = None,
    bands: tuple[int, int, int] | None = None,
    page: int | None = None,
    allow_truncated: bool | None = None,
) -> np.ndarray:
    """Read an image of any usual kind as 8-bit RGB.

    Args:
        image: a path; the content of an image file as bytes, or a file opened in binary mode,
            which is read from its beginning; a PIL image; or an array or a PyTorch tensor
            (H, W), (H, W, C) or (C, H, W) of 1, 3 or 4 channels: uint8, uint16 or float in [0, 1].
            Files, also given as bytes, are turned upright according to their EXIF orientation.
            Transparent pixels (alpha, a transparent palette entry, GDAL's no-data value or mask,
            NaN in a TIFF file) are blended with grey, and hold no keypoints in any method.
        channels: order of the colours in an array or a tensor: "bgr" for images of `cv2.imread`
            and `cv2.VideoCapture`. It does not apply to files and PIL images.
        max_megapixels: size limit of image files: larger ones are rejected before decoding, since
            a file of few bytes can hold billions of pixels. None: 200, or `--max-megapixels` in a
            command. One megapixel takes 3 MB, and up to 7 MB while it is read. Pillow itself reads
            WebP files of at most 178 megapixels (`PIL.Image.MAX_IMAGE_PIXELS`).
        value_range: the values of black and of white, such as (0, 4095) for a 12-bit sensor. None:
            the values that the file states. If it states none, black is 0, and white is 1 for
            floats. For uint16, it is the smallest of 255, 1023, 4095, 16383 and 65535 that no pixel
            exceeds, except hot pixels (up to 0.1%) and padding with 65535. A narrow band
            of uint16 values far from 0, as of a thermal camera, is spread over the grey levels,
            with a warning. Methods that take several images read them with one common range.
            Integers that are neither uint8 nor uint16 need this option.
        bands: numbers, from 1, of the three bands of a TIFF file or array that become red, green
            and blue: (4, 3, 2) for Landsat 8. None: the first three. Images of four bands without
            alpha, or of more than four bands, need this option.
        page: number, from 0, of the image to read if a file has several; thumbnails do not
            count. None: the largest image of a TIFF file (the first of equally large ones), and
            the first image of any other file.
        allow_truncated: read truncated files; the missing part is black or grey.

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        ImageError: the file is missing, truncated, damaged (where the format allows to detect it),
            too large or not an image; the array has a wrong shape, type or range or contains
            NaN; or a side is shorter than 16 pixels.
        MissingExtraError: the format needs a package that is not installed; the message names it.
        OptionError: an option is out of its range, or the order of the colours is unknown.

    Example:
        >>> load_image(np.zeros((20, 30), np.uint16)).shape
        (20, 30, 3)
    """
    check_channels(channels)
    options = reading_options(
        max_megapixels=max_megapixels,
        value_range=value_range,
        bands=bands,
        page=page,
        allow_truncated=allow_truncated,
    )
    return opaque_part(_load(image, channels, options, value_range=value_range, bands=bands))[0]


def load_pixels(
    image: Any, channels: Channels = "rgb", *, deep: bool = False, raw: bool = False
) -> np.ndarray:
    """Read an image like `load_image`; transparent pixels are marked in a fourth channel.

    If `deep`, images with more than 8 bits per channel become uint16. If `raw`, values are not
    scaled, and arrays and TIFF files keep all their bands, (H, W, C).
    """
    return _load(image, channels, reading_options(), deep=deep, raw=raw)


def load_visible(
    image: Any, channels: Channels = "rgb", ignore: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read an image like `load_image`; return it, and a mask of ignored and transparent pixels."""
    rgb, hidden = opaque_part(load_pixels(image, channels))
    if hidden is None or ignore is None:
        return rgb, ignore if hidden is None else hidden
    return rgb, hidden | check_ignore(ignore, hidden.shape)


def load_pair(
    images: tuple[Any, Any], channels: Channels, ignore: Any = None
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray | None, np.ndarray | None]]:
    """Load two images with one value range; return the images, and the masks of `load_visible`."""
    masks = ignore_masks(ignore, 2)
    with one_range(images, channels):
        first, mask0 = load_visible(images[0], channels, masks[0])
        second, mask1 = load_visible(images[1], channels, masks[1])
    return (first, second), (mask0, mask1)


@contextmanager
def one_range(images: Any, channels: Channels = "rgb") -> Iterator[ReadingOptions]:
    """Read all uint16 images in the block with one value range; yield the reading options.

    Every function that reads several images does so in such a block. The range is found from up to
    `SEEN_IMAGES` evenly chosen `images` that may have 16 bits. None is sought if the first of them
    has 8 bits or states its range. Open files and pipes are skipped: some are readable only once.
    """
    options, counts = reading_options(), np.zeros(1 << 16, np.int64)
    seen = [each for each in images if _may_be_deep(each)] if options.deep_range is None else []
    for image in seen[:: -(-len(seen) // SEEN_IMAGES) or 1]:
        with suppress(Exception), warnings.catch_warnings(action="ignore"):
            _load(image, channels, replace(options, counts=counts))
        if not counts.any():
            break
    if counts.any():
        found = options.value_range or find_range(counts)
        options = replace(options, deep_range=found)
    with read_with(options):
        yield options


def _may_be_deep(image: Any) -> bool:
    """Return whether an image may have 16 bits per channel, by its type or its first bytes."""
    if is_path(image) and Path(image).is_file():
        with suppress(OSError), open(image, "rb") as file:
            image = file.read(SIGNATURE_BYTES)
    if isinstance(image, (bytes, bytearray)):
        return image[:4] in TIFF_STARTS or _stated_bits(image) > 8
    return not is_file(image) and getattr(image, "dtype", None) != np.uint8


def _stated_bits(start: bytes | bytearray) -> int:
    """Return the bits per channel that the beginning of a PNG or JPEG 2000 file states, or 0."""
    header = start.find(b"ihdr")  # ISO/IEC 15444-1, I.5.3.1, and A.5.1 for a bare codestream
    if start[:4] == PNG_SIGNATURE[:4]:
        return int.from_bytes(start[24:25])
    if start[:4] == b"\xffO\xffQ" or header > 0:
        bits = 1 + int.from_bytes(start[42:43] if header < 0 else start[header + 14 : header + 15])
        return bits if bits <= 16 else 0  # above 16: signed, or bands of several depths
    return 0


def _load(
    image: Any,
    channels: Channels,
    options: ReadingOptions,
    *,
    deep: bool = False,
    raw: bool = False,
    **for_arrays: Any,  # options of this call; those of a command do not apply to arrays
) -> np.ndarray:
    if is_file(image):
        rgb = _read_file(image, options, deep, raw)
    elif hasattr(image, "convert") and hasattr(image, "getbands"):  # a PIL image
        if for_arrays.get("bands") is not None:
            raise OptionError("`bands` need a TIFF file or an array: leave them out")
        options = replace(options, value_range=for_arrays.get("value_range"))
        rgb = _from_pil(image, "the image", options, deep, raw)
    elif raw and isinstance(image, np.ndarray) and image.ndim in (2, 3):
        rgb = image.reshape(*image.shape[:2], -1)
    else:
        rgb = array_to_pixels(image, channels, deep=deep, **options.common, **for_arrays)
    height, width = rgb.shape[:2]
    if min(height, width) < MINIMUM_SIDE:
        raise ImageError(
            f"{file_name(image)} is {width}x{height} pixels: both sides must be at least "
            f"{MINIMUM_SIDE}"
        )
    return rgb


def found_in_each(
    images: Images, channels: Channels, ignore: Any, find: Callable[[np.ndarray, Any], Found]
) -> list[Found]:
    """Load the images of a list, tuple or batch one by one; return `find(pixels, mask)` of each."""
    if not isinstance(images, (list, tuple)) and getattr(images, "ndim", 0) != 4:
        raise OptionError(
            "a batch is a list or a 4-D array: give one image to the method without _batch"
        )
    masks, found = ignore_masks(ignore, len(images)), list[Found]()
    with one_range(images, channels) as reading:
        pass
    for number, image in enumerate(images):
        try:
            with read_with(reading):
                pixels = load_pixels(image, channels)
            found.append(find(pixels, masks[number]))
        except (ImageError, OptionError) as error:
            raise type(error)(f"images[{number}]: {error}") from None
        del pixels
    return found


def at_pixels(mask: np.ndarray | None, xy: np.ndarray) -> np.ndarray:
    """Return (N,) bool: whether a mask of `load_visible` is true at each of (N, 2) positions."""
    if mask is None:
        return np.zeros(len(xy), bool)
    columns, rows = np.rint(xy).clip(0, np.subtract(np.shape(mask)[::-1], 1)).astype(np.intp).T
    return np.asarray(mask)[rows, columns] != 0


def ignore_masks(ignore: Any, images: int) -> list[Any]:
    """Return the ignore mask of each image, from one mask for all images or a list of masks."""
    if not (isinstance(ignore, (list, tuple)) or getattr(ignore, "ndim", 2) == 3):
        return [ignore] * images
    if len(ignore) != images:
        raise OptionError(f"`ignore` has {len(ignore)} masks for {images} images: give one each")
    return list(ignore)


def luma(rgb: np.ndarray) -> np.ndarray:
    """Return the 8-bit luma (ITU-R BT.601) of a uint8 image of 3 or 4 channels, (H, W) uint8."""
    return cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY if rgb.shape[2] == 3 else cv2.COLOR_RGBA2GRAY)


def find_images(folder: str | Path, exclude: Sequence[Path] = ()) -> list[Path]:
    """List the image files below a folder in natural order: "2.png" comes before "10.png".

    Images that commands of this package have written into the folder are left out. Masks of other
    images, and images with suffixes not in `IMAGE_SUFFIXES`, are left out with a warning.

    Raises:
        ImageError: the folder is missing, is a file, or has no image outside of `exclude`.
    """
    from natsort import natsorted, ns

    root = Path(folder)
    if root.is_file():
        load_image(root)  # raises an error with advice if it is a video
        raise ImageError(f"{root} is a file: name the folder that it is in")
    if not root.is_dir():
        raise MissingImageError(f"there is no folder {root}: check the path")
    left_out = [p.resolve() for p in exclude if not root.resolve().is_relative_to(p.resolve())]
    files = [
        path
        for path in root.rglob("*")
        if path.is_file()
        and not any(part.startswith(".") for part in path.relative_to(root).parts)
        and not any(path.resolve().is_relative_to(other) for other in left_out)
    ]
    found = natsorted((p for p in files if p.suffix.lower() in IMAGE_SUFFIXES), alg=ns.PATH)
    made = {path for path in files if was_made(path, root)}
    names = {path.name for path in found}  # ortho.tif.ovr belongs to ortho.tif
    others = sorted(p for p in {*files} - {*found} - made if p.stem not in names and holds_image(p))
    tell_left_out(others, "images with unknown suffixes")
    if not found:
        raise ImageError(
            f"there is no image in {root}: it needs files that end in .jpg, .png, .tif or similar"
        )
    images = [path for path in found if path not in made]
    if not images:
        raise ImageError(f"all images in {root} are results of earlier runs: give files by name")
    return without_masks(images)


def name_images(paths: Sequence[Path], exclude: Sequence[Path] = ()) -> dict[str, Path]:
    """Return a dictionary of the given image files and those below the given folders, by name.

    A given file has its file name, other images have their path relative to the given folder. If
    two names would be the same, all names are paths relative to the common parent folder.
    """
    names: dict[Path, Path] = {}
    for path in paths:
        below = find_images(path, exclude) if path.is_dir() else [path]
        names |= {each: each.relative_to(path if path.is_dir() else path.parent) for each in below}
    names = {path: names[path] for path in without_masks(names)}
    if len({*names.values()}) < len(names):
        top = os.path.commonpath([path.parent.absolute() for path in names])
        names = {path: path.absolute().relative_to(top) for path in names}
    return {name.as_posix(): path for path, name in names.items()}


def _read_file(
    source: Any, options: ReadingOptions, deep: bool = False, raw: bool = False
) -> np.ndarray:
    with open_file(source) as (file, name):
        start, several = file.read(SIGNATURE_BYTES), True
        if start[:4] in TIFF_STARTS and not name.lower().endswith(RAW_SUFFIXES):
            rgb, orientation = read_tiff(file, name, options, deep, raw)
        elif options.bands is not None and not raw:
            raise OptionError(f"`bands` need a TIFF file or an array: leave them out for {name}")
        else:
            with open_image(file, options=options) as image:
                if _stated_bits(start) > 8 and (start[25] != GREY_PNG or image.format != "PNG"):
                    rgb = _by_opencv(file, name, options, deep, raw)
                else:
                    rgb = _from_pil(image, name, options, deep, raw)
                orientation, several = orientation_of(image), hasattr(image, "n_frames")
            del image  # frees its pixels before `UPRIGHT` makes another copy
        pages: list[int] = []
        with suppress(Exception):  # a file may be damaged after its first image
            pages = page_numbers(file) if several and options.page is None else []
    if len(pages) > 1:
        text = f"{name} holds {len(pages)} images, of which one is taken: choose it by `page`"
        warnings.warn(text, UserWarning, stacklevel=4)
    if is_path(source) and not raw and rgb.shape[2] == 3 and Path(f"{name}.msk").is_file():
        rgb = _behind_mask(rgb, name)
    return UPRIGHT[orientation](rgb) if orientation in UPRIGHT else rgb


def _behind_mask(rgb: np.ndarray, name: str) -> np.ndarray:
    """Make pixels transparent where NAME.msk, GDAL's mask next to an image file, is 0."""
    with open_image(f"{name}.msk", what="mask") as mask:
        shown = np.asarray(mask) != 0
    shown = shown.reshape(*shown.shape[:2], -1).any(axis=2)
    return on_grey(rgb, shown, 1, name) if shown.shape == rgb.shape[:2] else rgb


def _by_opencv(
    file: BinaryIO, name: str, options: ReadingOptions, deep: bool, raw: bool
) -> np.ndarray:
    """Read a PNG or JPEG 2000 file with 9 to 16 bits, whose values Pillow would change."""
    file.seek(0)
    values = cv2.imdecode(np.frombuffer(file.read(), np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise damaged_image(name, "it cannot be decoded")
    value_range = ALL_VALUES if raw else options.value_range
    common = options.common
    return array_to_pixels(values, "bgr", name, value_range=value_range, deep=deep, **common)


def orientation_of(image: Any) -> Any:
    """Return the EXIF orientation of a loaded image; a broken tag is ignored."""
    try:
        return image.getexif().get(ORIENTATION_TAG, 1)
    except Exception:  # Pillow's readers raise many kinds of errors
        return 1


def _from_pil(image: Any, name: str, options: ReadingOptions, deep: bool, raw: bool) -> np.ndarray:
    value_range = options.value_range
    try:
        image.load()
    except Exception as error:  # Pillow's decoders raise many kinds of errors
        raise damaged_image(name, error) from None
    if image.mode.startswith(("I", "F")):
        values = deep_values(image)
        white = 65535 if image.format == "PPM" else None  # Pillow scales white to this in PPM
        if raw and values.dtype == np.uint16:
            value_range = ALL_VALUES
        how = {"value_range": value_range, "white": white, "deep": deep, **options.common}
        rgb = array_to_pixels(values, name=name, **how)
        clear = image.info.get("transparency")
        return rgb if clear is None else on_grey(rgb, values != clear, 1, name)
    width, height = image.size
    rgb = np.empty((height, width, 3), np.uint8)
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        strip = image if rows >= height else image.crop((0, top, width, bottom))
        rgb[top:bottom] = _strip_to_rgb(strip)
    if value_range is not None:
        rgb = array_to_pixels(rgb, name=name, value_range=value_range)
    alpha = _alpha_of(image)
    return rgb if alpha is None else on_grey(rgb, alpha, 255, name)


def _alpha_of(image: Any) -> np.ndarray | None:
    """Return the alpha of a loaded PIL image of 8 bits, (H, W) uint8, or None."""
    if image.mode in ("RGBa", "La"):
        image = image.convert(image.mode.upper())
    elif "transparency" in image.info and image.mode in ("1", "L", "P", "RGB"):
        image = image.convert("RGBA")
    return np.asarray(image.getchannel("A")) if "A" in image.getbands() else None


def _strip_to_rgb(image: Any) -> np.ndarray:
    if image.mode == "P" and isinstance(image.info.get("transparency"), bytes):
        image = image.convert("RGBA")  # avoids a warning of Pillow about the alpha of palettes
    if image.mode == "La":
        image = image.convert("LA")  # Pillow converts "La" to no other mode
    return np.asarray(image.convert("RGB"))
