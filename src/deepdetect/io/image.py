"""Reading images of any usual kind, one or several, as 8-bit RGB or as luma.

Pixel convention everywhere: x right, y down, centre of the first pixel (0, 0).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import ImageError, MissingImageError, OptionError
from .._shared.image_array import Channels, array_to_rgb, check_channels
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from .._shared.records import was_made
from .image_file import IMAGE_SUFFIXES, damaged_image, file_name, is_file, open_image

Images = list[Any] | tuple[Any, ...] | np.ndarray
"""Several images: a list, a tuple, or a batch in an array of four dimensions."""

MINIMUM_SIDE = 16
"""Smallest width and height of an image, in pixels."""

ORIENTATION_TAG = 0x0112
# Tags of TIFF, and their values for signed integers, separate planes and a thumbnail.
SAMPLE_FORMAT, SIGNED, PLANES, SEPARATE, SUBFILE, REDUCED, BITS = 339, 2, 284, 2, 254, 1, 258

STRIP_PIXELS = 1 << 20
"""PIL images are converted by strips of about this size: whole copies take gigabytes."""

UPRIGHT: dict[int, Callable[[np.ndarray], np.ndarray]] = {
    2: lambda image: cv2.flip(image, 1),
    3: lambda image: cv2.rotate(image, cv2.ROTATE_180),
    4: lambda image: cv2.flip(image, 0),
    5: lambda image: cv2.transpose(image),
    6: lambda image: cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE),
    7: lambda image: cv2.flip(cv2.transpose(image), -1),
    8: lambda image: cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE),
}
"""What undoes each orientation of EXIF."""


@suggest_keywords
def load_image(
    image: Any, *, channels: Channels = "rgb", max_megapixels: float | None = None
) -> np.ndarray:
    """Read an image of any usual kind as 8-bit RGB.

    Args:
        image: a path; the content of an image file as bytes, or a file opened in binary mode,
            which is read from its beginning; a PIL image; or an array or a PyTorch tensor
            (H, W), (H, W, C) or (C, H, W) of 1, 3 or 4 channels: uint8, uint16 (full range
            0..65535) or float in [0, 1]. The fourth channel, alpha, is dropped. Files, also as
            bytes, are turned upright by their EXIF tag. Pixels of files and PIL images are
            of these types too, signed and 32-bit integers are refused.
        channels: the order of the colours in an array or a tensor: "bgr" for the images of
            `cv2.imread` and `cv2.VideoCapture`. Files and PIL images say theirs themselves.
        max_megapixels: larger files are refused before they are decoded, as a file of few bytes
            can hold billions of pixels. None: 200, or what `--max-megapixels` says.
            One megapixel takes 3 MB, and up to 7 MB while it is read.
            Of TIFF and WebP, Pillow reads 178 megapixels at most (`PIL.Image.MAX_IMAGE_PIXELS`).

    Returns:
        (H, W, 3) uint8 RGB.

    Raises:
        ImageError: the file is missing, truncated, damaged (as far as its format lets one
            see), too large or no image, the array has a wrong shape, type or range or holds
            NaN, or a side is shorter than 16 pixels.
        MissingExtraError: it is a HEIF image, and pillow-heif is not installed.
        OptionError: `max_megapixels` is not above 0, or the order of the colours is unknown.

    Example:
        >>> load_image(np.zeros((20, 30), np.uint16)).shape
        (20, 30, 3)
    """
    name = "the image"
    check_channels(channels)
    if hasattr(image, "convert") and hasattr(image, "getbands"):  # a PIL image
        rgb = _from_pil(image, name)
    elif is_file(image):
        rgb, name = _read_file(image, max_megapixels), file_name(image)
    else:
        rgb = array_to_rgb(image, channels, name)
    if min(rgb.shape[:2]) < MINIMUM_SIDE:
        height, width = rgb.shape[:2]
        raise ImageError(
            f"{name} is {width}x{height} pixels: both sides must be at least {MINIMUM_SIDE}"
        )
    return rgb


def load_each(images: Images, channels: Channels) -> Iterator[tuple[int, np.ndarray]]:
    """Load images when they are asked for, each with its place in the list, tuple or batch."""
    if not isinstance(images, (list, tuple)) and getattr(images, "ndim", 0) != 4:
        raise OptionError(
            "a batch is a list or a 4-D array: give one image to the method without _batch"
        )
    for number, image in enumerate(images):
        with image_named(number):
            rgb = load_image(image, channels=channels)
        yield number, rgb
        del rgb


@contextmanager
def image_named(number: int) -> Iterator[None]:
    """Let errors of an image say which of a list it is."""
    try:
        yield
    except (ImageError, OptionError) as error:
        raise type(error)(f"images[{number}]: {error}") from None


def ignore_masks(ignore: Any, images: int) -> list[Any]:
    """Return the ignore mask of each image: one for all, or as many as there are images."""
    if not (isinstance(ignore, (list, tuple)) or getattr(ignore, "ndim", 2) == 3):
        return [ignore] * images
    if len(ignore) != images:
        raise OptionError(f"`ignore` holds {len(ignore)} masks for {images} images: give one each")
    return list(ignore)


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
    """List the image files below a folder in natural order: "2.png" comes before "10.png".

    Pictures that commands of this package have made there are left out.

    Raises:
        ImageError: the folder is missing, is a file, or holds no image outside of `exclude`.
    """
    from natsort import natsorted, ns

    root = Path(folder)
    if root.is_file():
        raise ImageError(f"{root} is a file: name the folder that it is in")
    if not root.is_dir():
        raise MissingImageError(f"there is no folder {root}: check the path")
    left_out = [path.resolve() for path in exclude if path.resolve() != root.resolve()]
    found = natsorted(
        (
            path
            for path in root.rglob("*")
            if path.suffix.lower() in IMAGE_SUFFIXES
            and path.is_file()
            and not any(part.startswith(".") for part in path.relative_to(root).parts)
            and not any(path.resolve().is_relative_to(other) for other in left_out)
        ),
        alg=ns.PATH,
    )
    if not found:
        raise ImageError(
            f"there is no image in {root}: put files there that end in .jpg, .png, .tif or alike"
        )
    images = [path for path in found if not was_made(path, root)]
    if not images:
        raise ImageError(f"all images in {root} are results of earlier runs: name them, or others")
    return images


def _read_file(source: Any, max_megapixels: float | None) -> np.ndarray:
    with open_image(source, max_megapixels=max_megapixels) as image:
        rgb = _from_pil(image, file_name(source))
        orientation = _orientation(image)
    del image  # its pixels, before they are needed once more
    return UPRIGHT[orientation](rgb) if orientation in UPRIGHT else rgb


def _orientation(image: Any) -> Any:
    """Return the EXIF orientation of a loaded image; a broken tag is ignored."""
    if image.format == "TIFF":  # Pillow has turned it when it loaded it
        return 1
    try:
        return image.getexif().get(ORIENTATION_TAG, 1)
    except Exception:  # Pillow's readers raise many kinds
        return 1


def _from_pil(image: Any, name: str) -> np.ndarray:
    try:
        image.load()
    except Exception as error:  # Pillow's decoders raise many kinds
        raise damaged_image(name, error) from None
    # Pillow holds 16-bit PGM, and 10.3 also 16-bit PNG, in 32 bits; all else may have any range.
    wide = image.mode == "I" and image.format not in ("PNG", "PPM")
    tags = getattr(image, "tag_v2", {})
    if tags.get(PLANES) == SEPARATE and max(tags.get(BITS, (8,))) > 8:  # Pillow makes stripes
        raise ImageError(f"{name} holds separate planes of 16 bits: save it interleaved")
    if tags.get(SUBFILE, 0) & REDUCED:
        raise ImageError(f"{name} begins with a thumbnail: save the full image first")
    if wide or SIGNED in tags.get(SAMPLE_FORMAT, ()):
        raise ImageError(
            f"{name} holds 32-bit or signed integers, whose range is not known: convert it "
            "to 8 bits (mode L or RGB), 16 bits without sign (mode I;16) or float in [0, 1]"
        )
    width, height = image.size
    rgb = np.empty((height, width, 3), np.uint8)
    rows = max(1, STRIP_PIXELS // max(1, width))
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        strip = image if rows >= height else image.crop((0, top, width, bottom))
        rgb[top:bottom] = _strip_to_rgb(strip, name)
    return rgb


def _strip_to_rgb(image: Any, name: str) -> np.ndarray:
    if image.mode == "P" and isinstance(image.info.get("transparency"), bytes):
        image = image.convert("RGBA")  # Pillow warns when it drops such an alpha at once
    if image.mode == "La":
        image = image.convert("LA")  # the only mode that Pillow converts it to
    if image.mode == "I":
        return array_to_rgb(np.asarray(image).astype(np.uint16), name=name)
    if image.mode.startswith("I;16") or image.mode == "F":
        return array_to_rgb(np.asarray(image), name=name)
    return np.asarray(image.convert("RGB"))
