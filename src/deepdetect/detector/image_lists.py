"""Several images at once: lists, tuples and batches, and the work on each of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np

from .._shared.errors import ImageError, OptionError
from .._shared.image_array import Channels
from ..io.image import load_image

Images = list[Any] | tuple[Any, ...] | np.ndarray
Item = TypeVar("Item")


def image_list(images: Images) -> list[Any]:
    """Return the images of a list, a tuple, or an array of four dimensions.

    Raises:
        OptionError: it is none of these.

    Example:
        >>> import numpy as np
        >>> len(image_list(np.zeros((5, 3, 20, 30), np.uint8)))
        5
    """
    if isinstance(images, (list, tuple)) or getattr(images, "ndim", 0) == 4:
        return list(images)
    raise OptionError(
        "a batch is a list of images, or an array of four dimensions: of one image use the method "
        "without _batch"
    )


def load_each(images: list[Any], channels: Channels) -> Iterator[tuple[int, np.ndarray]]:
    """Load images when they are asked for, each with its place in the list."""
    for number, image in enumerate(images):
        with image_named(number):
            loaded = number, load_image(image, channels=channels)
        yield loaded
        del loaded


@contextmanager
def image_named(number: int) -> Iterator[None]:
    """Let errors of an image say which of a list it is."""
    try:
        yield
    except (ImageError, OptionError) as error:
        raise type(error)(f"images[{number}]: {error}") from None


def batches(
    items: Iterable[Item], size: Callable[[Item], Any], at_most: int
) -> Iterator[list[Item]]:
    """Yield items in their order, those that follow each other with the same size together.

    Example:
        >>> list(batches(["a", "b", "cc", "d", "e", "f"], len, 2))
        [['a', 'b'], ['cc'], ['d', 'e'], ['f']]
    """
    batch: list[Item] = []
    for item in items:
        if batch and size(item) != size(batch[0]):
            yield batch
            batch = []
        batch.append(item)
        del item  # who takes items out of a batch can free them
        if len(batch) == at_most:
            yield batch
            batch = []
    if batch:
        yield batch


def check_batch_size(batch_size: int) -> None:
    """Check how many images are to be run together.

    Raises:
        OptionError: it is no whole number from 1 on.
    """
    if not isinstance(batch_size, (int, np.integer)) or batch_size < 1:
        raise OptionError(f"`batch_size` must be a whole number from 1 on, not {batch_size!r}")


def ignore_masks(ignore: Any, images: int) -> list[Any]:
    """Return the ignore mask of each image.

    Raises:
        OptionError: their number differs from that of the images.
    """
    if not (isinstance(ignore, (list, tuple)) or getattr(ignore, "ndim", 2) == 3):
        return [ignore] * images
    if len(ignore) != images:
        raise OptionError(f"`ignore` holds {len(ignore)} masks for {images} images: give one each")
    return list(ignore)
