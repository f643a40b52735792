"""Several images at once: lists, tuples and batches, and the work on each of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from .._shared.errors import ImageError, OptionError

Images = list[Any] | tuple[Any, ...]
Found = TypeVar("Found")


def image_list(image: Any) -> list[Any] | None:
    """Return the images of a list, a tuple, or a batch of four dimensions; None of one image.

    Example:
        >>> image_list("left.png"), image_list(["left.png", "right.png"])
        (None, ['left.png', 'right.png'])
        >>> import numpy as np
        >>> len(image_list(np.zeros((5, 3, 20, 30), np.uint8)))
        5
    """
    if isinstance(image, (list, tuple)):
        # Rows of numbers are one image.
        rows = len(image) > 0 and isinstance(image[0], (list, tuple, int, float))
        return None if rows else list(image)
    return list(image) if getattr(image, "ndim", 0) == 4 else None


def for_each_image(image: Any, find: Callable[[Any, int], Found]) -> Any:
    """Call a function with an image, or with each of several; errors name which one it is."""
    images = image_list(image)
    if images is None:
        return find(image, 0)
    found = []
    for number, one in enumerate(images):
        try:
            found.append(find(one, number))
        except (ImageError, OptionError) as error:
            raise type(error)(f"images[{number}]: {error}") from None
    return found


def ignore_masks(ignore: Any, images: int | None) -> list[Any]:
    """Return the ignore mask of each image.

    Raises:
        OptionError: their number differs from that of the images.
    """
    several = isinstance(ignore, (list, tuple)) or getattr(ignore, "ndim", 2) == 3
    if images is None or not several:
        return [ignore] * (1 if images is None else images)
    if len(ignore) != images:
        raise OptionError(f"`ignore` holds {len(ignore)} masks for {images} images: give one each")
    return list(ignore)
