"""From a heat map to keypoints: threshold or density, suppression, a maximum number."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from .errors import OptionError
from .even_order import even_order


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one image.

    Attributes:
        xy: (N, 2) float32 positions, x right and y down in pixels, centre of the
            first pixel (0, 0).
        scores: (N,) float32 probabilities.
        image_size: (width, height) of the image in pixels.

    `len`, iteration over (x, y) rows and indexing by slices, masks and index arrays work.

    Raises:
        OptionError: the shapes do not fit together.

    Example:
        >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
        >>> len(points), points[points.scores > 0.8].xy.tolist()
        (2, [[1.0, 2.0]])
    """

    xy: np.ndarray
    scores: np.ndarray
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        xy = np.asarray(self.xy, np.float32)
        scores = np.asarray(self.scores, np.float32)
        if xy.size == 0:
            xy = xy.reshape(0, 2)
        if xy.ndim != 2 or xy.shape[1] != 2 or scores.shape != xy.shape[:1]:
            raise OptionError(
                f"keypoints need (N, 2) positions and (N,) scores, "
                f"not {xy.shape} and {scores.shape}"
            )
        object.__setattr__(self, "xy", xy)
        object.__setattr__(self, "scores", scores)
        object.__setattr__(self, "image_size", (int(self.image_size[0]), int(self.image_size[1])))

    @classmethod
    def empty(cls, image_size: tuple[int, int]) -> Keypoints:
        """Make a set without keypoints."""
        return cls(np.empty((0, 2), np.float32), np.empty(0, np.float32), image_size)

    @property
    def density(self) -> float:
        """Keypoints a pixel."""
        width, height = self.image_size
        return len(self) / (width * height)

    def __len__(self) -> int:
        return len(self.xy)

    def __getitem__(self, index: slice | np.ndarray | list[int]) -> Keypoints:
        if isinstance(index, (int, np.integer)):
            index = [int(index)]
        return Keypoints(self.xy[index], self.scores[index], self.image_size)

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter(self.xy)


@dataclass(frozen=True, eq=False)
class SelectionOptions:
    """Which pixels of a heat map become keypoints.

    Attributes:
        threshold: tau: pixels with a probability above it (paper: 0.5).
        density: wanted number of keypoints a pixel, in (0, 1]; takes the place of the
            threshold: the most probable pixels are taken, as many as that.
        max_keypoints: the most probable so many are kept.
        nms_radius: each keypoint, the most probable first, suppresses those at most so
            far from it in x and in y (0 suppresses none).
        ignore: (H, W) bool or number array, true where no keypoint is wanted.

    Raises:
        OptionError: a value is out of its range.
    """

    threshold: float = 0.5
    density: float | None = None
    max_keypoints: int | None = None
    nms_radius: int = 0
    ignore: np.ndarray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if not 0 <= self.threshold <= 1:
            raise OptionError(f"the threshold must lie in [0, 1], not {self.threshold}")
        if self.density is not None and not 0 < self.density <= 1:
            raise OptionError(f"the density must lie in (0, 1], not {self.density}")
        if self.max_keypoints is not None and self.max_keypoints < 1:
            raise OptionError(f"max_keypoints must be at least 1, not {self.max_keypoints}")
        if self.nms_radius < 0:
            raise OptionError(f"nms_radius must be 0 or more pixels, not {self.nms_radius}")
        if self.nms_radius != int(self.nms_radius):
            raise OptionError(f"nms_radius must be a whole number of pixels, not {self.nms_radius}")


def select_keypoints(
    heatmap: np.ndarray, options: SelectionOptions = SelectionOptions()
) -> Keypoints:
    """Choose the keypoints of a heat map.

    Args:
        heatmap: (H, W) float32 probability.
        options: what to choose. The order is: ignore mask, threshold, suppression,
            density or maximum number. Where probabilities are equal, as the many that float32
            rounds to 1, those come first that spread the keypoints evenly (`even_order`).

    Returns:
        Keypoints on pixel centres, in the order of rows and columns.

    Raises:
        OptionError: the ignore mask has another size than the map.

    Example:
        >>> heatmap = np.zeros((16, 16), np.float32)
        >>> heatmap[4, 9] = 0.9
        >>> select_keypoints(heatmap).xy.tolist()
        [[9.0, 4.0]]
    """
    height, width = heatmap.shape
    # With a density wanted, all but the impossible pixels may be needed.
    wanted = heatmap > (options.threshold if options.density is None else 0.0)
    if options.ignore is not None:
        ignore = np.asarray(options.ignore)
        if ignore.shape != heatmap.shape:
            raise OptionError(
                f"the ignore mask has shape {ignore.shape}, the image (height, width) "
                f"{heatmap.shape}: they must be equal"
            )
        wanted &= ~ignore.astype(bool)
    pixels = np.flatnonzero(wanted)
    scores = heatmap.ravel()[pixels]
    if options.nms_radius and len(pixels):
        kept = _suppress(pixels, scores, heatmap.shape, options.nms_radius)
        pixels, scores = pixels[kept], scores[kept]
    count = _wanted_count(options, heatmap.size)
    if count is not None and len(pixels) > count:
        kept = np.sort(_ranked(pixels, scores, heatmap.shape)[:count])
        pixels, scores = pixels[kept], scores[kept]
    row, column = np.divmod(pixels, width)
    return Keypoints(np.stack([column, row], 1).astype(np.float32), scores, (width, height))


def _ranked(pixels: np.ndarray, scores: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the rows from the best to the worst; equals are spread evenly over the image."""
    row, column = np.divmod(pixels, shape[1])
    spread = even_order(np.column_stack([column, row]), (shape[1], shape[0]))
    return np.lexsort((spread, -scores))


def _wanted_count(options: SelectionOptions, pixels: int) -> int | None:
    counts = []
    if options.density is not None:
        counts.append(round(options.density * pixels))
    if options.max_keypoints is not None:
        counts.append(options.max_keypoints)
    return min(counts) if counts else None


def _suppress(
    pixels: np.ndarray, scores: np.ndarray, shape: tuple[int, ...], radius: int
) -> np.ndarray:
    """Tell which pixels are kept when each kept one, best first, suppresses those around it.

    The map is nearly flat near 1, so pixels are compared by rank, which has no ties. All
    pixels that are the best of their window are kept at once, their neighbours fall out,
    and so on with what is left, until nothing is: the same as going through the list.
    """
    left = np.zeros(shape, np.float64)
    left.ravel()[pixels[_ranked(pixels, scores, shape)]] = np.arange(len(pixels), 0, -1)
    kept = np.zeros(shape, np.uint8)
    window = np.ones((2 * int(radius) + 1,) * 2, np.uint8)  # a box is dilated in linear time
    while left.any():
        # Beyond the border is -infinity.
        best = ((cv2.dilate(left, window) == left) & (left > 0)).astype(np.uint8)
        kept |= best
        left[cv2.dilate(best, window) > 0] = 0
    return kept.ravel()[pixels] > 0
