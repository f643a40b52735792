"""Several images at once: lists, tuples and batches, and the work on each of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from .._shared.errors import ImageError, OptionError
from .._shared.image_array import Channels
from ..io.image import load_image

Images = list[Any] | tuple[Any, ...] | np.ndarray


def load_each(images: Images, channels: Channels) -> Iterator[tuple[int, np.ndarray]]:
    """Load images when they are asked for, each with its place in the list, tuple or batch."""
    if not isinstance(images, (list, tuple)) and getattr(images, "ndim", 0) != 4:
        raise OptionError(
            "a batch is a list of images, or an array of four dimensions: of one image use the "
            "method without _batch"
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
