"""Conversion of arrays and tensors of any usual layout and type to RGB images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from .alpha import on_grey
from .errors import ImageError, check_name
from .value_range import ValueRange, counts_of, range_of_uint16, tell_if_little

Channels = Literal["rgb", "bgr"]
CHANNEL_COUNTS = (1, 3, 4)


def check_channels(channels: str) -> None:
    """Raise an OptionError if the channel order is neither "rgb" nor "bgr"."""
    check_name("channel order", channels, ("rgb", "bgr"))


def as_array(image: Any) -> np.ndarray:
    """Return an array-like, or a PyTorch tensor on any device, as a NumPy array.

    Raises:
        ImageError: the value is None, an iterator, a sparse or meta tensor, or has ragged rows.
    """
    if image is None:
        raise ImageError("the image is None, as `cv2.imread` returns for a missing file: check it")
    if hasattr(image, "__next__"):
        raise ImageError("the image is an iterator: give one image, or a list to `detect_batch`")
    if hasattr(image, "detach") and hasattr(image, "cpu"):  # a tensor
        if image.is_meta or str(image.layout) != "torch.strided":
            raise ImageError("a sparse tensor, or one on the device 'meta', is not an image")
        image = image.detach().cpu()
        if image.is_floating_point():
            image = image.float()  # NumPy has no bfloat16
    try:
        return np.asarray(image)
    except ValueError:
        raise ImageError("an image array must have rows of equal length") from None


def array_to_rgb(image: Any, channels: Channels = "rgb", **options: Any) -> np.ndarray:
    """Convert an array or tensor to RGB like `array_to_pixels`, but always to three channels."""
    return np.ascontiguousarray(array_to_pixels(image, channels, **options)[:, :, :3])


def array_to_pixels(
    image: Any,
    channels: Channels = "rgb",
    name: str = "the image",
    *,
    value_range: Sequence[float] | None = None,
    bands: Sequence[int] | None = None,
    white: int | None = None,
    call: ValueRange | None = None,
    counts: np.ndarray | None = None,
    deep: bool = False,
) -> np.ndarray:
    """Convert an array or PyTorch tensor to an (H, W, 3) RGB image, or (H, W, 4) as in `alpha`.

    The result is uint8 or, if `deep` is set and the input has more than 8 bits, uint16. `white` is
    the value of white in an unsigned image, if known. For uint16 images of unknown white, `call` is
    the value range shared by all images of a call, and the image's histogram is added to `counts`
    if given. Messages call the image `name`. Other arguments are as in `load_image`.

    Raises:
        ImageError: the image has an unsupported shape, type or range, or contains NaN.
        OptionError: the order of the channels is unknown.
    """
    check_channels(channels)
    array = as_array(image)
    if bands is not None:
        array = _select_bands(array, bands, name)
    array = _channels_last(array)
    if array.dtype.kind not in "buif":
        raise ImageError(f"an image cannot be of type {array.dtype}: use uint8, uint16 or float")
    colours = array[:, :, :3] if array.ndim == 3 else array
    if counts is not None and array.dtype == np.uint16 and white is None:
        counts += counts_of(colours)
    if value_range is None:
        value_range = _range_of(colours, name, white, call)
    values = _in_range(array, value_range, name, deep)
    if values.ndim == 2:
        return np.repeat(values[:, :, None], 3, axis=2)
    rgb = np.ascontiguousarray(values[:, :, :3] if channels == "rgb" else values[:, :, 2::-1])
    if array.shape[2] < 4:
        return rgb
    alpha = array[:, :, 3]
    # If alpha has over 8 bits, its largest value counts as opaque: 12-bit values end at 4095.
    opaque = 255 if array.dtype == np.uint8 else alpha.max(initial=1)
    return on_grey(rgb, alpha, opaque, name)


def deep_values(image: Any) -> np.ndarray:
    """Return the values of a PIL image of mode I or F; integers of a PNG or PPM become uint16."""
    values = np.asarray(image)
    of_16_bits = image.mode == "I" and image.format in ("PNG", "PPM")
    return values.astype(np.uint16) if of_16_bits else values


def to_8_bits(rgb: np.ndarray, value_range: Sequence[float] = (0, 65535)) -> np.ndarray:
    """Convert an image to uint8; `value_range` are the black and white of a uint16 image."""
    return rgb if rgb.dtype == np.uint8 else _in_range(rgb, value_range, "", False)


def from_16_bits(image: np.ndarray, value_range: Sequence[float]) -> np.ndarray:
    """Convert uint16 pixels that were read with `value_range` back to their values in the file."""
    low, high = value_range
    levels = np.arange(65536) * ((high - low) / 65535) + low
    return np.rint(levels.clip(0, 65535)).astype(np.uint16)[image]


def fill_planes(rgb: np.ndarray, planes: np.ndarray) -> None:
    """Write (H, W, 3) uint8 pixels, scaled to [0, 1], into float planes (3, H', W').

    If the planes are larger than the image, its last row and column are repeated.
    """
    below, right = planes.shape[1] - rgb.shape[0], planes.shape[2] - rgb.shape[1]
    if below or right:
        rgb = np.pad(rgb, ((0, below), (0, right), (0, 0)), mode="edge")
    np.multiply(rgb.transpose(2, 0, 1), np.float32(1 / 255), out=planes)


def srgb_to_linear() -> np.ndarray:
    """Return the linear intensities in [0, 1], shape (256,), of the sRGB levels (IEC 61966-2-1)."""
    value = np.arange(256) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _channels_last(array: np.ndarray) -> np.ndarray:
    shape = array.shape
    if array.ndim == 4:
        raise ImageError(
            f"an array of shape {shape} is a batch: give batch[0], or use `detect_batch`"
        )
    if array.ndim == 3 and shape[2] not in CHANNEL_COUNTS and shape[0] in CHANNEL_COUNTS:
        array = np.moveaxis(array, 0, 2)
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.ndim == 2 or (array.ndim == 3 and array.shape[2] in CHANNEL_COUNTS):
        return array
    raise ImageError(
        f"an image array has shape {shape}: it must be (height, width), (height, width, channels) "
        "or (channels, height, width), with 1, 3 or 4 channels"
        + ("; give several grey images as a list to `detect_batch`" if array.ndim == 3 else "")
    )


def _select_bands(array: np.ndarray, bands: Sequence[int], name: str) -> np.ndarray:
    """Return the chosen bands, whose numbers start at 1, as an array (H, W, bands).

    In `array`, the axis of the bands is the shorter one of the first and the last axis.
    """
    if array.ndim == 3 and array.shape[0] < array.shape[2]:
        array = np.moveaxis(array, 0, 2)
    if array.ndim != 3 or max(bands) > array.shape[2]:
        count = array.shape[2] if array.ndim == 3 else 1
        raise ImageError(f"{name} has {count} bands: leave `bands` out, or choose among these")
    return array[:, :, np.array(bands) - 1]


def _range_of(
    array: np.ndarray, name: str, white: int | None, call: ValueRange | None
) -> ValueRange:
    """Return the values that mean black and white in an image of this type."""
    kind, size = array.dtype.kind, array.dtype.itemsize
    if kind == "b":
        return 0, 1
    if kind == "u" and size == 1:
        return 0, white or 255
    if kind == "u" and size == 2:
        if white is None:
            return range_of_uint16(array, name, call)
        tell_if_little(array, white, name)
        return 0, white
    if kind == "f":
        low, high = (float(array.min()), float(array.max())) if array.size else (0.0, 1.0)
        if np.isfinite([low, high]).all() and (low < 0 or high > 1):
            raise ImageError(
                f"{name} spans [{low:g}, {high:g}]: scale floats to [0, 1], or give `value_range`"
            )
        tell_if_little(array, 1, name)
        return 0, 1
    raise ImageError(
        f"{name} is {array.dtype}, whose range is unknown: give `value_range`, or convert it to "
        "uint8, uint16, or float in [0, 1]"
    )


def _in_range(array: np.ndarray, value_range: Sequence[float], name: str, deep: bool) -> np.ndarray:
    """Scale an array to uint8 or uint16; the ends of `value_range` become black and white."""
    (low, high), size = value_range, array.dtype.itemsize
    if array.dtype == np.uint8 and (low, high) == (0, 255):
        return array
    top, kind = (65535, np.uint16) if deep and size > 1 else (255, np.uint8)

    def levels(values: np.ndarray) -> np.ndarray:
        if not np.isfinite(values).all():
            raise ImageError(f"{name} holds NaN or infinite values: replace them first")
        scaled = (values.astype(np.float64) - low) * (top / (high - low))
        return np.rint(scaled.clip(0, top)).astype(kind)

    if array.dtype.kind == "u" and size <= 2:
        return levels(np.arange(256**size))[array]
    found = np.empty(array.shape, kind)
    for row, values in enumerate(array):  # row by row, because a float64 image is large
        found[row] = levels(values)
    return found
