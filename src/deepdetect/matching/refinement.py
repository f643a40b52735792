"""Refine sparse matches to a fraction of a pixel, with the uncertainty of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from .._shared.errors import ImageError
from .._shared.image_array import Channels
from .._shared.machine import limited_threads
from .._shared.options import suggest_keywords
from ..features.matches import Matches
from ..geometry.alignment import Aligned, Alignment, align_patches
from ..geometry.images import gaussian_blur
from ..geometry.transforms import homography_derivatives
from ..io.image import load_image, luma

ALIGNMENT = Alignment(radius_px=7, max_shift_px=3.0, convergence_px=0.03, affine=True, cubic=False)
"""How matches are aligned. Among mutual matches of 2,048 points, 827 per pair of Oxford and 381 per
pair of HPatches are within 1 px after alignment, 722 and 309 before. A radius of 10 px gives 848
and 395, but in trials a pose AUC at 1 degree of 0.646 on a KITTI clip, where 7 px gave 0.659."""

BASE_SIGMA_PX = 0.8
"""Minimum sigma of the blur of both images: bilinear interpolation needs smooth images."""

SIGMAS_PX = 0.7, 1.0, 1.5, 2.0, 3.0
"""The sharper image of a pair is blurred by one of these sigmas, or not at all, whichever makes a
sample of patches correlate best. A wrong blur moves matches by up to half a pixel."""

SAMPLE = 128
"""Number of matches, evenly drawn, whose patches choose the blur. Chosen by hand."""

CERTAIN = 0.95
"""Patches that correlate this well are not aligned again from another affine map. Set by hand."""

MIN_SIGMA_PX = 0.03
"""Minimum standard deviation of an aligned position along each axis: errors of interpolation. On
synthetic views, the median error is then 1.07 standard deviations (1.18 would be exact)."""

POINT_SIGMA_PX, PIXEL_SIGMA_PX = 1.0, 0.35
"""Standard deviation along each axis of unrefined matches: of keypoints with sizes, and of those on
whole pixels (rounding alone causes 0.29). An aligned position is averaged with the unrefined one,
so that a patch that shows only an edge moves only across the edge. On four pairs of Oxford,
0.58 to 0.70 of guided matches are within 0.5 px before refinement, 0.73 to 0.92 after it."""

MAX_DEVIATIONS = 3.0
"""An alignment that moves a match by this many standard deviations is rejected. Set by hand."""


@suggest_keywords
@limited_threads()
def refine_matches(
    image0: Any, image1: Any, matches: Matches, *, channels: Channels = "rgb"
) -> Matches:
    """Move the ends of matches in the second image to a fraction of a pixel.

    The sharper image is blurred like the other. Then the patch around each match in the first image
    is aligned to the second under an affine map and a gain and offset of the brightness.

    Args:
        image0, image1: the images of the matches, anything `load_image` takes.
        matches: matches by keypoints, from `match_features` or `match_images`. Sizes and angles of
            keypoints and a homography, if there are any, give the first affine maps.
        channels: order of the colours in arrays: "rgb", or "bgr" as in OpenCV.

    Returns:
        The same matches, with new `points1` and with `covariances`. A match that cannot be aligned,
        for example since the images differ too much there, keeps its position, with the standard
        deviation of unrefined matches: 1 pixel, or 0.35 pixels for keypoints without sizes.
        Matches of a rectified pair (`Matches.subpixel`) are returned as they are.

    Raises:
        ImageError: an image cannot be read, or has another size than its keypoints' image.

    Example:
        >>> from deepdetect import PointDetector, match_features
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (32, 32), np.uint8).repeat(4, 0).repeat(4, 1)
        >>> features = PointDetector(100).extract(image)
        >>> matches = refine_matches(image, image, match_features(features, features))
        >>> bool(np.abs(matches.points1 - matches.points0).max() < 0.01)
        True
    """
    grays = []
    for name, image, points in (
        ("image0", image0, matches.keypoints0),
        ("image1", image1, matches.keypoints1),
    ):
        gray = luma(load_image(image, channels=channels))
        if gray.shape[::-1] != points.image_size:
            width, height = points.image_size
            raise ImageError(
                f"`{name}` has {gray.shape[1]}x{gray.shape[0]} pixels, but its keypoints are of an "
                f"image of {width}x{height}: give that image"
            )
        grays.append(gray.astype(np.float32))
    points0, points1 = (np.asarray(p, np.float64) for p in (matches.points0, matches.points1))
    if matches.subpixel:
        return matches
    if not len(matches):
        return replace(matches, covariances=np.empty((0, 2, 2)))
    starts = [*_first_affinities(matches)]
    sigmas = _sigmas(grays, points0, points1, starts)
    found = _aligned(grays, sigmas, points0, points1, starts)
    measured = _correlated(sigmas) * found.covariances + MIN_SIGMA_PX**2 * np.eye(2)
    exact = PIXEL_SIGMA_PX if matches.keypoints1.sizes is None else POINT_SIGMA_PX
    known = exact**2 * np.eye(2)
    moved, inverse = found.points1 - points1, np.linalg.inv(measured + known)
    deviations = np.einsum("ni,nij,nj->n", moved, inverse, moved) ** 0.5
    aligned = (found.converged & (deviations < MAX_DEVIATIONS))[:, None]
    gain = known @ inverse
    moved = np.where(aligned, np.einsum("nij,nj->ni", gain, moved), 0)
    covariances = np.where(aligned[:, None], gain @ measured, known)
    return replace(matches, points1=points1 + moved, covariances=covariances)


def _first_affinities(matches: Matches) -> Iterator[np.ndarray]:
    """Yield (M, 2, 2) initial affine maps: the homography's or identity; by sizes and angles."""
    geometry, count = matches.geometry, len(matches)
    if geometry is not None and geometry.model == "homography" and geometry.matrix is not None:
        yield homography_derivatives(matches.points0, geometry.matrix)
    else:
        yield np.tile(np.eye(2), (count, 1, 1))
    ends = (matches.keypoints0, matches.indices0), (matches.keypoints1, matches.indices1)
    if all(k.sizes is not None and k.angles is not None and (i >= 0).all() for k, i in ends):
        sizes, angles = (
            [getattr(keypoints, name)[rows].astype(np.float64) for keypoints, rows in ends]
            for name in ("sizes", "angles")
        )
        factor = sizes[1] / sizes[0] * np.exp(1j * np.deg2rad(angles[1] - angles[0]))
        yield np.array([[factor.real, -factor.imag], [factor.imag, factor.real]]).transpose(2, 0, 1)


def _sigmas(
    grays: list[np.ndarray], points0: np.ndarray, points1: np.ndarray, starts: list[np.ndarray]
) -> tuple[float, float]:
    """Return the blur sigma of each image (one is 0) that makes a sample of patches most alike."""
    rows = np.linspace(0, len(points0) - 1, min(SAMPLE, len(points0))).astype(int)
    some = points0[rows], points1[rows], [each[rows] for each in starts]
    ways = [*((sigma, 0.0) for sigma in SIGMAS_PX[::-1]), (0.0, 0.0)]
    ways += ((0.0, sigma) for sigma in SIGMAS_PX)
    likeness: dict[int, np.ndarray] = {}
    best, before = len(SIGMAS_PX), -1
    while best != before:
        before, near = best, range(max(best - 1, 0), min(best + 2, len(ways)))
        for way in near:
            if way not in likeness:
                likeness[way] = _aligned(grays, ways[way], *some).correlations
        known = np.max([likeness[way] for way in near], axis=0) > 0
        for way in near if known.any() else ():
            if np.median((likeness[way] - likeness[best])[known]) > 0:
                best = way
    return ways[best]


def _correlated(sigmas: tuple[float, float]) -> float:
    """Return the factor by which blurred, and so correlated, noise raises variances of positions.

    White noise of the two images is blurred by s0 and s1, and their content by the larger one, S.
    If the power spectrum of the content falls with the squared frequency, as that of photographs
    does, the least-squares position gets S^2 / (S^2 + s^2) of each noise's variance before its
    blur, and the pixels have 1 / (4 pi s^2) of it.
    """
    squares = np.square(sigmas) + BASE_SIGMA_PX**2
    gains = squares.max() / (squares.max() + squares)
    return float(4 * np.pi * gains.sum() / (1 / squares).sum())


def _aligned(
    grays: list[np.ndarray],
    sigmas: tuple[float, float],
    points0: np.ndarray,
    points1: np.ndarray,
    starts: list[np.ndarray],
) -> Aligned:
    """Align matches in blurred images, each from the affinity with which it correlates best."""
    first, second = (
        gaussian_blur(gray, float(np.hypot(sigma, BASE_SIGMA_PX)))
        for gray, sigma in zip(grays, sigmas, strict=True)
    )
    best = align_patches((first, second), points0, points1, starts[0], ALIGNMENT)
    for start in starts[1:]:
        rows = np.flatnonzero(best.correlations < CERTAIN)
        other = align_patches((first, second), points0[rows], points1[rows], start[rows], ALIGNMENT)
        better = other.correlations > best.correlations[rows]
        for name in ("points1", "correlations", "affinities", "covariances"):
            getattr(best, name)[rows[better]] = getattr(other, name)[better]
    return best
