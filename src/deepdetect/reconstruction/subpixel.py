"""Matches below the pixel: the patch about a point is laid onto the second image.

Inverse compositional alignment (Baker and Matthews, "Lucas-Kanade 20 years on", 2004), with gain
and offset of the light taken out. The patch is turned and sheared as its surroundings are: first
as all matches are together (a similarity), then as the refined matches around it are (an affinity).

Chosen by measurement (benchmarks/two_view.py) against a parabola through the correlation of the
same patches, turned alike, at the nearest whole pixels. Share of the matches of the Motorcycle pair
within 0.25 / 0.5 px of the truth, of those that converge (88 %): 65 / 83 % (parabola 49 / 74 %;
before, of all matches, 36 / 63 %); with its views turned against each other by 14 degrees (84 %)
62 / 79 % (parabola 31 / 59 %; before 9 / 29 %).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from .._shared.errors import OptionError
from .._shared.parallel import parallel_for

AROUND = 15
"""Side in pixels of the window whose matches give a patch its affinity."""

RIDGE = 20.0
"""Matches spread over the window that the similarity of all counts for beside those in it: few, or
those of one line, give no affinity of their own."""

SETTLED = 0.01
ROUGHLY = 0.05
"""A smaller shift, in pixels, is no shift; in the first alignment, which only serves the second."""

SAMPLE = 5000
"""Matches that the similarity is estimated from."""


@dataclass(frozen=True)
class SubpixelOptions:
    """How matches are refined.

    Attributes:
        reach: the patch has 2 reach + 1 pixels a side.
        sigma: of the Gaussian weight of its pixels, in pixels.
        rounds: of the alignment, at the most.
        farthest: pixels that a match may move in each of the two alignments.
        least_correlation: of both patches at the end; a match under it has not converged.

    Raises:
        OptionError: a value is out of its range.
    """

    reach: int = 4
    sigma: float = 2.0
    rounds: int = 15
    farthest: float = 2.0
    least_correlation: float = 0.8

    def __post_init__(self) -> None:
        if not 1 <= self.reach <= 31:
            raise OptionError(f"the reach of a patch must lie in [1, 31], not {self.reach}")
        for name in ("sigma", "rounds", "farthest"):
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} must be above 0, not {getattr(self, name)}")
        if not -1 <= self.least_correlation <= 1:
            raise OptionError(
                f"the least correlation must lie in [-1, 1], not {self.least_correlation}"
            )


@dataclass(frozen=True, eq=False)
class RefinedMatches:
    """Matches below the pixel.

    Attributes:
        points1: (N, 2) float64 positions in the second image; as they were where the alignment
            did not converge.
        converged: (N,) bool.
        correlation: (N,) float32 of both patches, in [-1, 1]; 0 where there was nothing to align.
    """

    points1: np.ndarray
    converged: np.ndarray
    correlation: np.ndarray


def refine_matches(
    gray0: np.ndarray,
    gray1: np.ndarray,
    points0: np.ndarray,
    points1: np.ndarray,
    options: SubpixelOptions = SubpixelOptions(),
) -> RefinedMatches:
    """Refine the second positions of matches.

    Args:
        gray0, gray1: (H, W) uint8 luma.
        points0: (N, 2) whole pixels of the first image.
        points1: (N, 2) positions in the second, right within a pixel or two.
        options: of the alignment.

    Returns:
        The refined positions. Flat patches, those that reach over the border, those that move
        too far, and those that stay unlike have not converged. The result does not depend on the
        number of threads.

    Raises:
        OptionError: a first position is not on a pixel of its image, or an option is out of range.

    Example:
        >>> image = np.random.default_rng(0).integers(0, 256, (60, 60)).astype(np.uint8)
        >>> image = cv2.GaussianBlur(image, (0, 0), 2)
        >>> moved = cv2.warpAffine(image, np.float32([[1, 0, 0.4], [0, 1, 0]]), (60, 60))
        >>> point = np.array([[30, 30]])
        >>> refine_matches(image, moved, point, point).points1.round(1).tolist()
        [[30.4, 30.0]]
    """
    pixels0 = np.rint(np.asarray(points0, np.float64)).reshape(-1, 2)
    inside = (pixels0 >= 0).all() and (pixels0 < (gray0.shape[1], gray0.shape[0])).all()
    if not inside or (pixels0 != np.asarray(points0).reshape(-1, 2)).any():
        raise OptionError("the first points of matches to refine must be whole pixels of the image")
    pixels0 = pixels0.astype(np.int64)
    start = np.ascontiguousarray(points1, np.float64).reshape(-1, 2)
    known = np.isfinite(start).all(1)
    known[known] = ((start[known] >= 0) & (start[known] < gray1.shape[::-1])).all(1)
    if not known.all():
        found = refine_matches(gray0, gray1, pixels0[known], start[known], options)
        result = RefinedMatches(start.copy(), known.copy(), np.zeros(len(start), np.float32))
        result.points1[known], result.converged[known] = found.points1, found.converged
        result.correlation[known] = found.correlation
        return result
    if not len(pixels0):
        return RefinedMatches(start, known, np.zeros(0, np.float32))
    images = gray0.astype(np.float32), gray1.astype(np.float32)
    together = similarity(pixels0, start)
    shapes = np.broadcast_to(together, (len(pixels0), 2, 2))
    found = _aligned(images, pixels0, start, shapes, options, ROUGHLY)
    shapes = local_affinities(pixels0, found.points1, found.converged, gray0.shape, together)
    return _aligned(images, pixels0, found.points1, shapes, options)


def similarity(points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
    """Return how all matches together turn and scale the first image, (2, 2) float64."""
    every = -(-len(points0) // SAMPLE)
    first, second = (
        np.ascontiguousarray(points[::every], np.float64) for points in (points0, points1)
    )
    if len(first) < 3:
        return np.eye(2)
    matrix, _ = cv2.estimateAffinePartial2D(first, second, method=cv2.LMEDS)
    usable = matrix is not None and np.isfinite(matrix).all() and (matrix[:, :2] != 0).any()
    return matrix[:, :2] if usable else np.eye(2)


def local_affinities(
    pixels0: np.ndarray,
    points1: np.ndarray,
    sure: np.ndarray,
    shape: tuple[int, ...],
    together: np.ndarray,
) -> np.ndarray:
    """Fit an affinity to the sure matches in the window about each.

    Args:
        pixels0: (N, 2) whole pixels of the first image, each once.
        points1: (N, 2) their matches.
        sure: (N,) bool, those that count.
        shape: (H, W) of the first image.
        together: (2, 2), what few or badly spread matches fall back on.

    Returns:
        (N, 2, 2) float32, derivatives of the second position by the first.
    """
    column, row = np.asarray(pixels0, np.int64).T
    # Sums of squares are of differences: keep the numbers small.
    across, down = column - shape[1] / 2, row - shape[0] / 2
    rest = points1 - np.column_stack([across, down]) @ together.T

    def sums(values: np.ndarray | float) -> np.ndarray:
        image = np.zeros(shape[:2])
        image[row[sure], column[sure]] = np.broadcast_to(values, len(row))[sure]
        window, border = (AROUND, AROUND), cv2.BORDER_CONSTANT
        image = cv2.boxFilter(image, -1, window, normalize=False, borderType=border)
        return image[row, column]

    count, sum_x, sum_y = sums(1.0), sums(across), sums(down)
    count = np.maximum(np.rint(count), 1)
    ridge = RIDGE * (AROUND**2 - 1) / 12
    xx = sums(across**2) - sum_x**2 / count + ridge
    yy = sums(down**2) - sum_y**2 / count + ridge
    xy = sums(across * down) - sum_x * sum_y / count
    result = np.empty((len(column), 2, 2))
    for axis in range(2):
        values = rest[:, axis]
        mean = sums(values) / count
        by_x = sums(across * values) - sum_x * mean
        by_y = sums(down * values) - sum_y * mean
        result[:, axis, 0] = (yy * by_x - xy * by_y) / (xx * yy - xy**2)
        result[:, axis, 1] = (xx * by_y - xy * by_x) / (xx * yy - xy**2)
    return (result + together).astype(np.float32)


def _aligned(
    images: tuple[np.ndarray, np.ndarray],
    pixels0: np.ndarray,
    start: np.ndarray,
    shapes: np.ndarray,
    options: SubpixelOptions,
    settled: float = SETTLED,
) -> RefinedMatches:
    from .subpixel_kernel import align

    offsets = np.arange(-options.reach, options.reach + 1)
    window = np.exp(-(offsets[:, None] ** 2 + offsets**2) / (2 * options.sigma**2))
    refined = np.empty((len(pixels0), 2))
    converged = np.empty(len(pixels0), bool)
    correlation = np.empty(len(pixels0), np.float32)
    arguments = (
        *(*images, pixels0, start, np.ascontiguousarray(shapes, np.float32)),
        *(window.astype(np.float32), int(options.rounds), settled, float(options.farthest)),
        *(np.float32(options.least_correlation), refined, converged, correlation),
    )
    parallel_for(len(pixels0), lambda first, last: align(first, last, *arguments))
    return RefinedMatches(refined, converged, correlation)
