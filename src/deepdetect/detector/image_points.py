"""Points of a whole photograph, at the size that the heat map would be computed at."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .._shared.errors import DeepDetectError
from .._shared.opencv import cv2, is_lack_of_memory
from ..features.keypoints import Keypoints
from ..features.selection import SelectionOptions, check_ignore
from ..io.image import luma
from .heatmap import MAX_AUTO_PIXELS, HeatmapOptions

if TYPE_CHECKING:
    from .points.ranker import Ranker


def find_points(
    rgb: np.ndarray,
    options: SelectionOptions,
    seen: HeatmapOptions = HeatmapOptions(),
    ranker: Ranker | None = None,
) -> Keypoints:
    """Detect the best keypoints of all scales of a loaded image.

    Args:
        rgb: (H, W, 3) uint8.
        options: how many, how they are spread, and where none is wanted.
        seen: images over two megapixels are scaled down to that, as for the heat map, unless the
            resolution is "native".
        ranker: None: the one inside the package.
    """
    from .points.detection import PointOptions, detect_points

    gray = luma(rgb)
    height, width = gray.shape
    ignore = None if options.ignore is None else check_ignore(options.ignore, gray.shape)
    scale = (MAX_AUTO_PIXELS / gray.size) ** 0.5
    chosen = PointOptions(max_keypoints=options.max_keypoints, spread=options.spread)
    if seen.resolution == "native" or scale >= 1:
        return detect_points(gray, chosen, ignore=ignore, ranker=ranker)
    size = [max(1, round(side * scale)) for side in (width, height)]
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    if ignore is not None:
        # Wherever a pixel of the small image, or one beside it, holds something to be ignored.
        share = cv2.resize(ignore.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        ignore = cv2.dilate((share > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
    found = detect_points(small, chosen, ignore=ignore, ranker=ranker)
    factor = np.divide((width, height), size)
    return replace(
        found,
        xy=(found.xy + 0.5) * factor - 0.5,
        image_size=(width, height),
        sizes=None if found.sizes is None else found.sizes * factor.mean(),
    )


@contextmanager
def memory_named(shape: tuple[int, ...], images: int = 1) -> Iterator[None]:
    """Make lack of memory, in work on images of this shape, an error of one sentence."""
    try:
        yield
        return
    except MemoryError:
        pass
    except Exception as error:
        if not is_lack_of_memory(error):
            raise
    height, width = shape[:2]
    if images > 1:
        raise DeepDetectError(
            f"there is not enough memory for {images} images of {width}x{height} pixels at once: "
            "use a smaller `batch_size`"
        )
    raise DeepDetectError(
        f"there is not enough memory for an image of {width}x{height} pixels: "
        "use `resolution='auto'`, fewer keypoints, or a smaller image"
    )
