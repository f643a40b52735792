"""Images in arrays and tensors of any usual layout and type, as 8-bit RGB and as planes."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from .errors import ImageError, check_name

Channels = Literal["rgb", "bgr"]
CHANNEL_COUNTS = (1, 3, 4)


def check_channels(channels: str) -> None:
    """Refuse an unknown order of the colours of an image in an array."""
    check_name("channel order", channels, ("rgb", "bgr"))


def as_array(image: Any) -> np.ndarray:
    """Return an array-like, or a PyTorch tensor of any device, as an array.

    Raises:
        ImageError: it is None or an iterator, or its rows are of unequal length.
    """
    if image is None:
        raise ImageError("the image is None, as `cv2.imread` returns for a missing file: check it")
    if hasattr(image, "__next__"):
        raise ImageError("an image is an iterator: give one image, or a list to `detect_batch`")
    if hasattr(image, "detach") and hasattr(image, "cpu"):  # a tensor
        if image.is_meta or str(image.layout) != "torch.strided":
            raise ImageError("a tensor on the device meta, or a sparse one, is no image: fill it")
        image = image.detach().cpu()
        if image.is_floating_point():
            image = image.float()  # NumPy has no bfloat16
    try:
        return np.asarray(image)
    except ValueError:
        raise ImageError("an image array must have rows of equal length") from None


def array_to_rgb(image: Any, channels: Channels = "rgb", name: str = "the image") -> np.ndarray:
    """Convert an image in an array or a PyTorch tensor, as of `load_image`, to (H, W, 3) uint8 RGB.

    Raises:
        ImageError: it has another shape, type or range, or holds NaN; `name` is what it is called.
        OptionError: the order of the channels is unknown.
    """
    check_channels(channels)
    values = _to_uint8(_channels_last(as_array(image)), name)
    if values.ndim == 2:
        return np.repeat(values[:, :, None], 3, axis=2)
    return np.ascontiguousarray(values[:, :, :3] if channels == "rgb" else values[:, :, 2::-1])


def fill_planes(rgb: np.ndarray, planes: np.ndarray) -> None:
    """Write (H, W, 3) uint8 to larger (3, H, W) float32: the last row and column are repeated."""
    below, right = planes.shape[1] - rgb.shape[0], planes.shape[2] - rgb.shape[1]
    if below or right:
        rgb = np.pad(rgb, ((0, below), (0, right), (0, 0)), mode="edge")
    np.multiply(rgb.transpose(2, 0, 1), np.float32(1 / 255), out=planes)


def srgb_to_linear() -> np.ndarray:
    """Return the linear light in [0, 1] of each of the 256 levels of sRGB (IEC 61966-2-1)."""
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
                f"{name} spans [{array.min():g}, {array.max():g}]: scale floats to [0, 1] first"
            )
        return np.rint(array * np.float32(255)).astype(np.uint8)
    raise ImageError(f"an image cannot be of type {array.dtype}: use uint8, uint16 or float")
