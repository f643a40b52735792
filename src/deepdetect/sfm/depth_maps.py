"""Depth maps of images with known cameras.

A small copy of each image is matched with its best neighbours together, by semi-global matching;
pixels that correlate badly take planes of others; and inverse depths are fitted to the grey values
at full size. A surface near a pixel is a plane throughout, so that slanted ones are matched as well
as others. What has no texture, and does not lie between textures of one surface, has no depth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from .._shared.machine import parallel_for
from .._shared.opencv import cv2
from .._shared.records import file_state
from ..geometry.camera import Camera, PosedView, angles_between
from ..io.image import load_image, luma
from ..matching.stereo.sgm import LANES, OUTSIDE_COST, WRONG_PLACE_BITS, aggregate, census
from .colmap import CameraIntrinsics
from .mapping import RegisteredImage, SparseModel

MATCHED_NEIGHBOURS = 4
"""Images that each one is matched with."""

NEIGHBOURS = 8
"""Images whose depth maps it is compared with, the matched ones among them."""

MIN_COMMON_POINTS = 30
"""Sparse points that both see."""

IDEAL_ANGLE_DEG = 5.0
"""Between the lines of sight from both: smaller ones count less."""

MAX_ANGLE_DEG = 30.0
"""Larger ones count less, since surfaces look different."""

MAX_SIDE_PX = 2000
"""Longer sides are scaled down to this."""

CACHED_IMAGES = 16
"""Prepared images that a process keeps: following references share neighbours."""

SMALL_SCALE = 0.5
"""Of the copies that are searched, at most."""

MAX_VOLUME = 3e7
"""Pixels of such a copy times inverse depths; with more, it is smaller."""

TAIL_FRACTION, DEPTH_MARGIN = 0.002, 0.2
"""Of the inverse depths of the sparse points in an image, at each end, which may be wrong; and of
their range, added at both ends: what is searched."""

MIN_FAR = 0.1
"""Least inverse depth that is searched, relative to the least of the sparse points."""

MAX_APPROACH = 0.5
"""Of the way to the middle of the searched depths, that a neighbour is ahead; it is moved away."""

PARALLAX_QUANTILE = 0.5
"""Of how far matches move with the inverse depth, over the image; steps are so fine."""

SAME_SURFACE_PX = 1.0
"""An inverse depth that moves the match in a small copy by more belongs to another surface."""

FIT_RADIUS_PX = 3
"""Of the windows in which planes are fitted to the inverse depths of a small copy."""

FIT_TOLERANCES_PX = (4, 2, 1)
"""Of these fits, one after the other: the first follows steep surfaces, such as the ground."""

MIN_FITTED = 12
"""Pixels that a plane is fitted to, at least: smaller patches apart from all around are wrong."""

WINDOW_RADIUS_PX, WINDOW_SPACING_PX = 4, 2
"""Of the windows that are compared at full size, and of their pixels that are."""

BLUR_SIGMA_PX = 1.0
"""Of both images before, so that these pixels stand for all."""

NOISE_LEVELS = 1.0
"""Grey levels a pixel, which are added to all gradients."""

JUMPS = (16, 8, 4, 2, 1)
"""Distances over which planes spread, in pixels of the depth map."""

SURE_CORRELATION = 0.9
"""With which a pixel keeps its own plane."""

MIN_CORRELATION = 0.5
"""Of the window of a pixel with that of a neighbour which takes part in its refinement."""

SMOOTHING_RADII = (4, 3)
"""Of the fits after each refinement, in pixels of the depth map."""

MIN_WEIGHT = 0.02
"""Of a pixel without texture in these fits; half of the others have more than 0.5."""

MIN_VIEWS = 3
"""Images that must agree, the reference among them; `fusion` asks some places for others."""

DEPTH_PIXEL = np.dtype(
    [("plane", np.float32, 3), ("error", np.float32), ("color", np.uint8, 3)], align=True
)
"""Of a depth map: the inverse depth, NaN where there is none, and its changes per pixel of the
image to the right and down; the distance in pixels from the matches of each neighbour alone (root
mean square); and the sRGB colour."""


def find_references(sparse: SparseModel) -> list[list[RegisteredImage]]:
    """Choose the neighbours of each image: those that share many points at a good angle.

    Returns images, those that see most points first, each with its neighbours, the best first.
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
    """Match the first image with the others; (H, W) `DEPTH_PIXEL`.

    It has every `stride_px` pixels of a row and of a column. `points` are those of the sparse
    model, among whose depths it searches.
    """
    rgbs, views = zip(*(prepared_image(folder, image) for image in images), strict=True)
    grays = [luma(rgb) for rgb in rgbs]
    size = np.array(views[0].camera.size)
    xy, depth = views[0].project(points)
    seen = ((xy >= 0) & (xy < size)).all(axis=1) & (depth > 0)
    low, high = np.quantile(1 / depth[seen], [TAIL_FRACTION, 1 - TAIL_FRACTION])
    margin = DEPTH_MARGIN * (high - low)
    small, step = _search(grays, views, (max(low - margin, MIN_FAR * low), high + margin))
    # From the pixels of the small copy to those of the depth map.
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
    """Search inverse depths by semi-global matching of small copies of the images.

    Returns (h, w, 3) planes in pixels of the small copy of the first, and the change of the inverse
    depth that moves a match there by a pixel.
    """
    from .dense_kernels import choose_rows, cost_rows

    # Not where a camera that moves forward has passed.
    passed = max(-relative_projection(views[0], view)[1][2] for view in views[1:])
    middle = min(float(np.mean(searched)), MAX_APPROACH / max(passed, 1e-9))
    parallax = max(_parallax(views[0], view, middle) for view in views[1:])
    count = parallax * (searched[1] - searched[0]) * SMALL_SCALE + 1
    volume = count * grays[0].size * SMALL_SCALE**2
    scale = SMALL_SCALE * min(1.0, (MAX_VOLUME / volume) ** (1 / 3))
    small = [_scaled(view, scale) for view in views]
    copies = [
        cv2.resize(gray, view.camera.size, interpolation=cv2.INTER_AREA)
        for gray, view in zip(grays, small, strict=True)
    ]
    count = -(-math.ceil(count * scale / SMALL_SCALE) // LANES) * LANES
    inverse = np.linspace(*searched, count)
    own = copies[0]
    size = np.array(own.shape[::-1])
    # Neighbours are warped by the plane of the middle depth: what is left of another depth is a
    # shift and a growth of the whole image.
    warps, corners = [], np.empty((len(copies) - 1, 2, 2, count))  # first and last, x and y
    for view, places in zip(small[1:], corners, strict=True):
        matrix, vector = relative_projection(small[0], view)
        warp = matrix + middle * np.outer(vector, [0, 0, 1])
        shift = np.linalg.solve(warp, vector)[:, None] * (inverse - middle)
        growth = np.where(1 + shift[2] > 0, 1 + shift[2], np.inf)
        places[:] = (np.stack([[0, 0], size - 1])[..., None] + shift[:2]) / growth
        warps.append(warp)
    first = np.floor(corners.min(axis=(0, 1, 3))).clip(-size, 0).astype(np.int64) - 1
    last = np.ceil(corners.max(axis=(0, 1, 3))).clip(size, 2 * size).astype(np.int64) + 1
    words = np.stack(
        [
            _warped_census(copy, warp, first, last)
            for copy, warp in zip(copies[1:], warps, strict=True)
        ]
    )
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
    """Return the census of an image at the pixels `first` to `last` of another, by a homography."""
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
    """Fit a plane to the inverse depths around each pixel that are about on its own plane."""
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
    """Refine (H, W, 3) planes by the grey values at full size; also return errors in pixels."""
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
        # Slopes are per pixel of the depth map while it is fitted.
        planes = _fit(np.dstack([refined, planes[..., 1:] * stride_px]), weights, radius, tolerance)
        planes[..., 1:] /= stride_px
    # Windows reach into a texture beside their pixel.
    reach = np.ones((2 * -(-WINDOW_RADIUS_PX // stride_px) + 1,) * 2, np.uint8)
    textured = cv2.erode((sure | np.isnan(planes[..., 0])).astype(np.uint8), reach) > 0
    planes[~_enclosed(planes, textured, stride_px, tolerance)] = np.nan
    return planes, errors


def _enclosed(planes: np.ndarray, sure: np.ndarray, stride_px: int, tolerance: float) -> np.ndarray:
    """Return which pixels of a depth map are `sure`, or on one surface between two that are.

    The two are to the left and right, or above and below. Elsewhere the depth is only continued
    from one side, such as that of a roof into the sky.
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
    """Return where a pixel or one above it is known, and no surface begins in between."""
    rows = np.arange(len(known))[:, None]
    last, first = (np.maximum.accumulate(np.where(each, rows, -1)) for each in (known, begins))
    return last >= first


def relative_projection(first: PosedView, second: PosedView) -> tuple[np.ndarray, np.ndarray]:
    """Return A (3, 3) and b (3,): the pixel q of inverse depth w is seen at A (q, 1) + w b."""
    moved, matrix = second.relative_to(first), second.camera.matrix
    return matrix @ moved.rotation @ np.linalg.inv(first.camera.matrix), matrix @ moved.translation


def relative_projections(
    first: PosedView, others: Sequence[PosedView], back: bool = False
) -> np.ndarray:
    """Return (K, 3, 4) `relative_projection` to others, or `back` from them."""
    pairs = [(other, first) if back else (first, other) for other in others]
    return np.array([np.column_stack(relative_projection(*pair)) for pair in pairs])


def _parallax(first: PosedView, second: PosedView, inverse_depth: float) -> float:
    """Return by how many pixels matches move with the inverse depth, a quantile of the image.

    Near the epipole, which lies ahead of a camera that moves forward, they do not move.
    """
    matrix, vector = relative_projection(first, second)
    x, y = (np.linspace(0, side - 1, 7)[1:-1] for side in first.camera.size)
    pixels = np.array([[across, down, 1] for across in x for down in y])
    seen = pixels @ matrix.T + inverse_depth * vector
    moved = (vector[:2] - seen[:, :2] / seen[:, 2:] * vector[2]) / seen[:, 2:]
    lengths = np.linalg.norm(moved[seen[:, 2] > 0], axis=1)
    return float(np.quantile(lengths, PARALLAX_QUANTILE)) if len(lengths) else 0.0


def prepared_image(folder: Path, image: RegisteredImage) -> tuple[np.ndarray, PosedView]:
    """Return an image without its distortion at most `MAX_SIDE_PX` long, and its view."""
    path, view = folder / image.view.name, limited_view(image.view)
    return _undistorted(path, file_state(path), image.intrinsics, view.camera), view


@lru_cache(maxsize=CACHED_IMAGES)
def _undistorted(
    path: Path, state: tuple[int, int], intrinsics: CameraIntrinsics, camera: Camera
) -> np.ndarray:
    """Read an image of this `file_state`, which extraction has let pass, without its distortion."""
    rgb = load_image(path, max_megapixels=np.inf)
    if camera.size != intrinsics.size:
        rgb = cv2.resize(rgb, camera.size, interpolation=cv2.INTER_AREA)
    return intrinsics.undistort(rgb, camera)


def limited_view(view: PosedView) -> PosedView:
    """Return a view of at most `MAX_SIDE_PX`."""
    return _scaled(view, min(1.0, MAX_SIDE_PX / max(view.camera.size)))


def _scaled(view: PosedView, scale: float) -> PosedView:
    if scale == 1:
        return view
    width, height = view.camera.size
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return replace(view, camera=view.camera.scaled(size))
