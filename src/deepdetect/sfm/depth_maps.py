"""Compute depth maps of images whose cameras are known.

Semi-global matching of downscaled images gives inverse depths, to which planes are fitted. A pixel
whose plane matches other images badly may take that of another pixel. Planes are then refined on
full-size images. Pixels without texture get a depth only between textured ones of their surface.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from .._shared.records import file_state
from ..geometry.camera import Camera, PosedView, angles_between
from ..io.image import load_image, luma
from ..io.image_file import ReadingOptions, reading_options
from ..matching.stereo.sgm import LANES, OUTSIDE_COST, WRONG_PLACE_BITS, aggregate, census
from .colmap import CameraIntrinsics
from .mapping import RegisteredImage, SparseModel

MATCHED_NEIGHBOURS, NEIGHBOURS, MIN_COMMON_POINTS = 4, 8, 30
"""An image is matched with at most `MATCHED_NEIGHBOURS` neighbours, because each takes time. Its
depth map is compared with those of at most `NEIGHBOURS` neighbours. A neighbour must share at least
`MIN_COMMON_POINTS` sparse points with the image. Chosen by hand."""

IDEAL_ANGLE_DEG, MAX_ANGLE_DEG = 5.0, 30.0
"""Neighbours are ranked by the sparse points that they share with the image. A point whose two
lines of sight form less than `IDEAL_ANGLE_DEG` counts less, because its depth is uncertain, as does
a point above `MAX_ANGLE_DEG`, because surfaces then look different. Chosen by hand."""

MAX_SIDE_PX, CACHED_IMAGES = 2000, 16
"""Images whose longer side exceeds `MAX_SIDE_PX` are scaled down to it, to limit time and memory. A
process caches `CACHED_IMAGES` undistorted images, because successive images share neighbours."""

SMALL_SCALE, MAX_VOLUME = 0.5, 3e7
"""Semi-global matching scales images to at most SMALL_SCALE (half the scale takes 1/8 of the time),
and computes at most MAX_VOLUME costs (pixels times inverse depths), to save memory."""

TAIL_FRACTION, DEPTH_MARGIN, MIN_FAR = 0.002, 0.2, 0.1
"""The search range spans the inverse depths of the sparse points, except for `TAIL_FRACTION` of
them at each end, which may be wrong. The range is then extended at each end by `DEPTH_MARGIN` times
its length, but not below `MIN_FAR` times the smallest inverse depth. Chosen by hand."""

MAX_APPROACH = 0.5
"""The search first warps all images to the first at one depth. This depth is so large that no other
camera lies ahead of the first by more than this fraction of it. Chosen by hand."""

PARALLAX_QUANTILE = 0.5
"""A step of the search through inverse depths moves matches by one pixel, at this quantile of all
matches: the median, because matches near the epipole hardly move."""

SAME_SURFACE_PX = 1.0
"""Two inverse depths belong to one surface if their matches in the downscaled images of the search
are at most this far apart."""

FIT_RADIUS_PX, FIT_TOLERANCES_PX, MIN_FITTED = 3, (4, 2, 1), 12
"""Planes are fitted to the downscaled depth map three times, in windows of radius `FIT_RADIUS_PX`,
with tolerances in steps of the search: first a wide one, so that frontal planes can become as steep
as the ground. Fits to under `MIN_FITTED` pixels are dropped as wrong. Chosen by hand."""

WINDOW_RADIUS_PX, WINDOW_SPACING_PX = 4, 2
"""Radius of the windows compared between images, and spacing of their pixels. Chosen by hand."""

BLUR_SIGMA_PX, NOISE_LEVELS = 1.0, 1.0
"""A blur of BLUR_SIGMA_PX lets the pixels read in a window represent the pixels between them. Noise
of NOISE_LEVELS grey levels is assumed: weaker gradients move no depth. Chosen by hand."""

JUMPS = (16, 8, 4, 2, 1)
"""A pixel tries the planes of pixels at these distances in the depth map, one distance in each of
five passes. A plane can thus spread over 31 pixels."""

SURE_CORRELATION, MIN_CORRELATION = 0.9, 0.5
"""A pixel whose window correlates by SURE_CORRELATION or more tries no other plane, to save time. A
neighbour refines a depth only if windows correlate by MIN_CORRELATION or more. Chosen by hand."""

SMOOTHING_RADII, MIN_WEIGHT = (4, 3), 0.02
"""Planes are refined twice, and each time smoothed by a fit in windows of these radii, in pixels of
the depth map. In the fit, untextured pixels have the weight `MIN_WEIGHT`, and half of the textured
pixels have weights above 0.5. Chosen by hand."""

MIN_VIEWS = 3
"""A depth is kept if at least this number of images agree on it, its own included: a third image
confirms the first two. Some places, such as depth edges, have other limits (see `fusion`)."""

DEPTH_PIXEL = np.dtype(
    [("plane", np.float32, 3), ("error", np.float32), ("color", np.uint8, 3)], align=True
)
"""A pixel of a depth map. `plane` is its inverse depth (NaN if unknown), and the change of inverse
depth per image pixel to the right and down. `error` is the root mean square distance, in pixels,
from the matches at this depth to those that each neighbour alone would give. `color` is sRGB."""


def find_references(sparse: SparseModel) -> list[list[RegisteredImage]]:
    """Return, for each image, a list of the image itself and then its best neighbours.

    The best neighbours share many sparse points with the image, seen at a good angle. An image with
    fewer than `MIN_VIEWS - 1` neighbours is left out.
    """
    found = []
    for image in sorted(sparse.images.values(), key=lambda image: -len(image.points)):
        scored: list[tuple[float, RegisteredImage]] = []
        shared = sparse.common_points(image)
        for other, count in zip(sparse.images.values(), shared, strict=True):
            if other is image or count < MIN_COMMON_POINTS:
                continue
            common = np.intersect1d(image.points, other.points)
            lines = [sparse.points[common] - each.view.centre for each in (image, other)]
            angle = np.degrees(angles_between(*lines))
            weights = np.minimum(angle / IDEAL_ANGLE_DEG, 1) ** 1.5
            weights = weights * np.minimum(MAX_ANGLE_DEG / np.maximum(angle, 1e-9), 1) ** 2
            scored.append((float(weights.sum()), other))
        scored.sort(key=lambda each: -each[0])
        images = [image, *(other for _, other in scored[:NEIGHBOURS])]
        if len(images) >= MIN_VIEWS:
            found.append(images)
    return found


def depth_map(
    folder: Path, images: Sequence[RegisteredImage], points: np.ndarray, stride_px: int
) -> np.ndarray:
    """Match the first image with the others; return its depth map, (H, W) `DEPTH_PIXEL`.

    The map has a pixel for every `stride_px`-th pixel of the image in each direction. The search
    covers the depths of the sparse model's `points` (N, 3) that the first image shows.
    """
    rgbs, views = zip(*(prepared_image(folder, image) for image in images), strict=True)
    grays = [luma(rgb) for rgb in rgbs]
    size = np.array(views[0].camera.size)
    xy, depth = views[0].project(points)
    seen = ((xy >= 0) & (xy < size)).all(axis=1) & (depth > 0)
    low, high = np.quantile(1 / depth[seen], [TAIL_FRACTION, 1 - TAIL_FRACTION])
    margin = DEPTH_MARGIN * (high - low)
    small, step = _search(grays, views, (max(low - margin, MIN_FAR * low), high + margin))
    # Resample from the pixels of the downscaled image to those of the depth map.
    ratio = np.divide(small.shape[1::-1], size)
    whole = [np.arange(0, side, stride_px) for side in size]
    places = [(at + 0.5) * each - 0.5 for at, each in zip(whole, ratio, strict=True)]
    column, row = (
        np.rint(at).astype(np.int64).clip(0, side - 1)
        for at, side in zip(places, small.shape[1::-1], strict=True)
    )
    planes = small[row[:, None], column]
    planes[..., 0] += planes[..., 1] * (places[0] - column)
    planes[..., 0] += planes[..., 2] * (places[1] - row)[:, None]
    planes[..., 1:] *= ratio
    made = np.empty(planes.shape[:2], DEPTH_PIXEL)
    made["plane"], made["error"] = _refine(grays, views, planes, stride_px, step)
    made["color"] = rgbs[0][::stride_px, ::stride_px]
    return made


def _search(
    grays: Sequence[np.ndarray], views: Sequence[PosedView], searched: tuple[float, float]
) -> tuple[np.ndarray, float]:
    """Search the range `searched` of inverse depths by semi-global matching of downscaled images.

    Returns the planes (h, w, 3), in pixels of the downscaled first image, and the step between two
    inverse depths, which moves a match in the downscaled images by about one pixel.
    """
    from .dense_kernels import choose_rows, cost_rows

    passed = max(-relative_projection(views[0], view)[1][2] for view in views[1:])
    middle = min(float(np.mean(searched)), MAX_APPROACH / max(passed, 1e-9))
    parallax = max(_parallax(views[0], view, middle) for view in views[1:])
    count = parallax * (searched[1] - searched[0]) * SMALL_SCALE + 1
    volume = count * grays[0].size * SMALL_SCALE**2
    scale = SMALL_SCALE * min(1.0, (MAX_VOLUME / volume) ** (1 / 3))
    small = [_scaled(view, scale) for view in views]
    resized = partial(cv2.resize, interpolation=cv2.INTER_AREA)
    copies = [*map(resized, grays, (view.camera.size for view in small))]
    count = -(-math.ceil(count * scale / SMALL_SCALE) // LANES) * LANES
    inverse = np.linspace(*searched, count)
    own = copies[0]
    size = np.array(own.shape[::-1])
    # Neighbours are warped by the homography of the middle depth. For any other depth, the warped
    # image then only has to be shifted and scaled as a whole.
    warps, corners = [], np.empty((len(copies) - 1, 2, 2, count))  # image, first/last, x/y, depth
    for view, places in zip(small[1:], corners, strict=True):
        matrix, vector = relative_projection(small[0], view)
        warp = matrix + middle * np.outer(vector, [0, 0, 1])
        shift = np.linalg.solve(warp, vector)[:, None] * (inverse - middle)
        growth = np.where(1 + shift[2] > 0, 1 + shift[2], np.inf)
        places[:] = (np.stack([[0, 0], size - 1])[..., None] + shift[:2]) / growth
        warps.append(warp)
    first = np.floor(corners.min(axis=(0, 1, 3))).clip(-size, 0).astype(np.int64) - 1
    last = np.ceil(corners.max(axis=(0, 1, 3))).clip(size, 2 * size).astype(np.int64) + 1
    pairs = zip(copies[1:], warps, strict=True)
    words = np.stack([_warped_census(*pair, first, last) for pair in pairs])
    tables = []
    for axis in (0, 1):
        along = np.linspace(corners[:, 0, axis], corners[:, 1, axis], size[axis], axis=-1)
        at = np.rint(along).clip(first[axis], last[axis]) - first[axis]
        tables.append(at.astype(np.int32))
    cost = np.empty((*own.shape, count), np.uint8)
    hidden_cost = np.uint8(OUTSIDE_COST * WRONG_PLACE_BITS)
    parallel_for(len(own), cost_rows, census(own), words, *tables, hidden_cost, cost)
    chosen = np.empty(own.shape, np.float32)
    parallel_for(len(own), choose_rows, aggregate(own, cost), chosen)
    step = inverse[1] - inverse[0]
    planes = np.zeros((*own.shape, 3), np.float32)
    planes[..., 0] = searched[0] + step * chosen
    weights = np.ones(own.shape, np.float32)
    for tolerance in FIT_TOLERANCES_PX:
        planes = _fit(planes, weights, FIT_RADIUS_PX, tolerance * step)
    return planes, step


def _warped_census(
    gray: np.ndarray, warp: np.ndarray, first: np.ndarray, last: np.ndarray
) -> np.ndarray:
    """Return the census of an image warped by a homography, with `HIDDEN` outside the image.

    `first` and `last` are the upper left and the lower right pixel (x, y) of the warped image.
    """
    from .dense_kernels import HIDDEN

    across, down = last - first + 1
    warp = warp @ [[1, 0, first[0]], [0, 1, first[1]], [0, 0, 1]]
    how = cv2.WARP_INVERSE_MAP
    whole = np.ones_like(gray)
    shown = cv2.warpPerspective(whole, warp, (across, down), flags=how | cv2.INTER_NEAREST) > 0
    shown &= warp[2, 0] * np.arange(across) + warp[2, 1] * np.arange(down)[:, None] + warp[2, 2] > 0
    shown[[0, -1]] = shown[:, [0, -1]] = False
    words = census(cv2.warpPerspective(gray, warp, (across, down), flags=how | cv2.INTER_LINEAR))
    return np.where(shown, words, HIDDEN)


def _fit(planes: np.ndarray, weights: np.ndarray, radius: int, tolerance: float) -> np.ndarray:
    """Fit a plane around each pixel to the inverse depths near its current plane."""
    from .dense_kernels import fit_rows

    fitted = np.empty_like(planes)
    parallel_for(len(planes), fit_rows, planes, weights, radius, tolerance, MIN_FITTED, fitted)
    return fitted


def _refine(
    grays: Sequence[np.ndarray],
    views: Sequence[PosedView],
    planes: np.ndarray,
    stride_px: int,
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Refine planes (H, W, 3) by matching full-size images; also return their errors in pixels."""
    from .dense_kernels import propagate_rows, refine_rows

    blurred = [cv2.GaussianBlur(gray.astype(np.float32), (0, 0), BLUR_SIGMA_PX) for gray in grays]
    sizes = np.array([view.camera.size for view in views[1:]])
    others = np.zeros((len(sizes), *sizes.max(axis=0)[::-1]), np.float32)
    for page, image in zip(others, blurred[1:], strict=True):
        page[: image.shape[0], : image.shape[1]] = image
    maps = relative_projections(views[0], views[1:])
    window = WINDOW_RADIUS_PX, WINDOW_SPACING_PX, np.float32(NOISE_LEVELS)
    compared = stride_px, blurred[0], others, sizes, maps, *window
    shape = planes.shape[:2]
    scores = np.full(shape, -1, np.float32)
    for jump in (0, *JUMPS):
        better, found = np.empty_like(planes), np.empty_like(scores)
        before = planes, scores, jump, SURE_CORRELATION
        parallel_for(len(planes), propagate_rows, *before, *compared, better, found)
        planes, scores = better, found
    tolerance = SAME_SURFACE_PX * step
    for radius in SMOOTHING_RADII:
        refined, errors, certainty = np.empty((3, *shape), np.float32)
        made = refined, errors, certainty
        limits = tolerance, MIN_CORRELATION, MIN_VIEWS - 1
        parallel_for(len(planes), refine_rows, planes, *compared, *limits, *made)
        sure = certainty > 0
        usual = np.median(certainty[sure]) if sure.any() else 1
        weights = certainty / (certainty + usual) + np.float32(MIN_WEIGHT)
        # The fit needs slopes per pixel of the depth map. All other code has them per image pixel.
        planes = _fit(np.dstack([refined, planes[..., 1:] * stride_px]), weights, radius, tolerance)
        planes[..., 1:] /= stride_px
    # A window can have texture although its middle pixel does not, so the textured area is eroded.
    reach = np.ones((2 * -(-WINDOW_RADIUS_PX // stride_px) + 1,) * 2, np.uint8)
    textured = cv2.erode((sure | np.isnan(planes[..., 0])).astype(np.uint8), reach) > 0
    planes[~_enclosed(planes, textured, stride_px, tolerance)] = np.nan
    return planes, errors


def _enclosed(planes: np.ndarray, sure: np.ndarray, stride_px: int, tolerance: float) -> np.ndarray:
    """Return a mask of the pixels that are `sure`, or lie between two sure pixels of one surface.

    The two sure pixels are to the left and right of the pixel, or above and below it. All other
    depths are extrapolated from one side only, for example from a roof into the sky.
    """
    found = sure.copy()
    for axis in (0, 1):
        surface, known = (np.moveaxis(each, axis, 0) for each in (planes, sure))
        slope = stride_px * surface[..., 2 - axis]
        jump = np.diff(surface[..., 0], axis=0) - (slope[1:] + slope[:-1]) / 2
        edges = np.pad(~(np.abs(jump) <= tolerance), ((1, 1), (0, 0)), constant_values=True)
        before = _reached(known, edges[:-1])
        after = _reached(known[::-1], edges[1:][::-1])[::-1]
        found |= np.moveaxis(before & after, 0, axis)
    return found


def _reached(known: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Return a mask of `known` pixels and the pixels below each, until a new surface `begins`."""
    rows = np.arange(len(known))[:, None]
    last, first = (np.maximum.accumulate(np.where(each, rows, -1)) for each in (known, begins))
    return last >= first


def relative_projection(first: PosedView, second: PosedView) -> tuple[np.ndarray, np.ndarray]:
    """Return A (3, 3) and b (3,), which project pixels of the first view to the second.

    Pixel (x, y) with inverse depth w projects to A (x, y, 1) + w b, in homogeneous coordinates.
    """
    moved, matrix = second.relative_to(first), second.camera.matrix
    return matrix @ moved.rotation @ np.linalg.inv(first.camera.matrix), matrix @ moved.translation


def relative_projections(
    first: PosedView, others: Sequence[PosedView], back: bool = False
) -> np.ndarray:
    """Return A and b of `relative_projection` as (K, 3, 4), from the first view or `back` to it."""
    pairs = [(other, first) if back else (first, other) for other in others]
    return np.array([np.column_stack(relative_projection(*pair)) for pair in pairs])


def _parallax(first: PosedView, second: PosedView, inverse_depth: float) -> float:
    """Return the pixels that the median match moves per unit of inverse depth, at a given depth."""
    matrix, vector = relative_projection(first, second)
    x, y = (np.linspace(0, side - 1, 7)[1:-1] for side in first.camera.size)
    pixels = np.array([[across, down, 1] for across in x for down in y])
    seen = pixels @ matrix.T + inverse_depth * vector
    moved = (vector[:2] - seen[:, :2] / seen[:, 2:] * vector[2]) / seen[:, 2:]
    lengths = np.linalg.norm(moved[seen[:, 2] > 0], axis=1)
    return float(np.quantile(lengths, PARALLAX_QUANTILE)) if len(lengths) else 0.0


def prepared_image(folder: Path, image: RegisteredImage) -> tuple[np.ndarray, PosedView]:
    """Return an undistorted image, whose longer side is at most `MAX_SIDE_PX`, and its view."""
    path, view = folder / image.view.name, limited_view(image.view)
    how = reading_options()
    return _undistorted(path, file_state(path), image.intrinsics, view.camera, how), view


@lru_cache(maxsize=CACHED_IMAGES)
def _undistorted(
    path: Path,
    state: tuple[int, int],
    intrinsics: CameraIntrinsics,
    camera: Camera,
    how: ReadingOptions,
) -> np.ndarray:
    """Read and undistort an image. `state` changes with the file, which renews the cache."""
    rgb = load_image(path, max_megapixels=np.inf)
    if camera.size != intrinsics.size:
        rgb = cv2.resize(rgb, camera.size, interpolation=cv2.INTER_AREA)
    return intrinsics.undistort(rgb, camera)


def limited_view(view: PosedView) -> PosedView:
    """Return a view, scaled down if its longer side exceeds `MAX_SIDE_PX`."""
    longest = max(view.camera.size)
    return view if longest <= MAX_SIDE_PX else _scaled(view, MAX_SIDE_PX / longest)


def _scaled(view: PosedView, scale: float) -> PosedView:
    width, height = (max(1, round(side * scale)) for side in view.camera.size)
    return replace(view, camera=view.camera.scaled((width, height)))
