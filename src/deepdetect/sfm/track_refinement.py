"""Sub-pixel refinement of tracks: the patches around all observations of a point are aligned.

Keypoints are detected in each photograph by itself, and a detector's positions of one point scatter
by some tenths of a pixel. Once poses and points are known roughly, so is how the surface around a
point looks from each view: the patch of one view, the reference, is aligned with the others, by the
inverse compositional algorithm (Baker and Matthews, "Lucas-Kanade 20 years on", 2004) with an
affine warp that begins with that of the surface's plane. The reference stays where it is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from ..geometry.posed_view import PosedView

BLOCK = 2000
"""Patches that are aligned at once, which bounds the memory."""


@suggest_keywords
@dataclass(frozen=True)
class TrackRefinementOptions:
    """How the observations of a point are aligned.

    Attributes:
        radius_px: of the square patches, whose sides are twice that and one.
        smoothing_sigma_px: of the photographs, so that their gradients are those of what both show.
        neighbours: points whose plane is taken for that of a point's surface.
        max_normal_angle_deg: between the plane's normal and the direction to the cameras; the plane
            of steeper ones is turned to that.
        iterations: of each alignment at most.
        min_step_px: it has converged when the centre moves by less.
        max_move_px: an observation that moves further stays where it was.
        min_correlation: of the aligned patches; below it the observation stays where it was.

    Raises:
        OptionError: a value is out of its range.
    """

    radius_px: int = 7
    smoothing_sigma_px: float = 0.7
    neighbours: int = 12
    max_normal_angle_deg: float = 65.0
    iterations: int = 15
    min_step_px: float = 0.01
    max_move_px: float = 2.0
    min_correlation: float = 0.8

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("radius_px", "iterations", "min_step_px", "max_move_px"),
            not_negative=("smoothing_sigma_px",),
            between={
                "neighbours": (3, 1000),
                "max_normal_angle_deg": (0, 89),
                "min_correlation": (-1, 1),
            },
        )


@dataclass(frozen=True, eq=False)
class Observations:
    """Where points are seen.

    Attributes:
        points: (N,) rows of the points, ascending.
        views: (N,) numbers of the views.
        xy: (N, 2) float64 positions in pixels, centre of the first pixel (0, 0).
    """

    points: np.ndarray
    views: np.ndarray
    xy: np.ndarray


def refine_observations(
    images: Mapping[int, np.ndarray],
    views: Mapping[int, PosedView],
    points: np.ndarray,
    seen: Observations,
    options: TrackRefinementOptions = TrackRefinementOptions(),
) -> tuple[np.ndarray, np.ndarray]:
    """Align the patches around all observations of each point.

    Args:
        images: (H, W) uint8 luma by the number of the view.
        views: cameras and poses by the number of the view.
        points: (P, 3) float64.
        seen: the observations.
        options: how.

    Returns:
        (N, 2) float64 positions, and (N,) bool, which of them are aligned: reference observations
        are, where another one of their point is.
    """
    smooth = {
        number: cv2.GaussianBlur(image, (0, 0), options.smoothing_sigma_px).astype(np.float32)
        if options.smoothing_sigma_px
        else image.astype(np.float32)
        for number, image in images.items()
    }
    normals = surface_normals(points, seen, views, options)
    reference = _reference_observations(points, normals, seen, views)
    others = np.flatnonzero(reference != np.arange(len(seen.xy)))
    refined, aligned = seen.xy.copy(), np.zeros(len(seen.xy), bool)
    for start in range(0, len(others), BLOCK):
        rows = others[start : start + BLOCK]
        base = reference[rows]
        affine = _plane_affinities(points, normals, seen, views, base, rows)
        places, good = _align(smooth, seen, base, rows, affine, options)
        refined[rows[good]] = places[good]
        aligned[rows[good]] = True
        aligned[base[good]] = True
    return refined, aligned


def surface_normals(
    points: np.ndarray,
    seen: Observations,
    views: Mapping[int, PosedView],
    options: TrackRefinementOptions = TrackRefinementOptions(),
) -> np.ndarray:
    """Return the (P, 3) normals, towards the cameras, of the planes of each point's neighbours."""
    towards = np.zeros_like(points)
    centres = np.array([views[int(number)].centre for number in seen.views]).reshape(-1, 3)
    rays = centres - points[seen.points]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.add.at(towards, seen.points, rays)
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    count = min(options.neighbours, len(points))
    if count < 3:
        return towards
    centred = np.ascontiguousarray(points - points.mean(axis=0), np.float32)
    index = cv2.flann.Index(centred, {"algorithm": 4, "leaf_max_size": 10})  # one exact kd-tree
    nearest, _ = index.knnSearch(centred, count, params={"checks": -1})
    near = points[nearest] - points[nearest].mean(axis=1, keepdims=True)
    _, directions = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    normals = directions[:, :, 0]
    cosine = np.einsum("ij,ij->i", normals, towards)
    normals = normals * np.where(cosine < 0, -1.0, 1.0)[:, None]
    # A normal that is too steep is turned about the line of sight, which keeps its direction.
    limit = np.radians(options.max_normal_angle_deg)
    across = normals - np.abs(cosine)[:, None] * towards
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    turned = np.cos(limit) * towards + np.sin(limit) * across
    return np.where((np.abs(cosine) < np.cos(limit))[:, None], turned, normals)


def _reference_observations(
    points: np.ndarray, normals: np.ndarray, seen: Observations, views: Mapping[int, PosedView]
) -> np.ndarray:
    """Return for each observation the one of its point that sees the surface in middling detail."""
    detail = np.empty(len(seen.xy))
    for number in np.unique(seen.views):
        rows = np.flatnonzero(seen.views == number)
        view = views[int(number)]
        rays = view.centre - points[seen.points[rows]]
        distance = np.linalg.norm(rays, axis=1)
        cosine = np.einsum("ij,ij->i", rays, normals[seen.points[rows]]) / distance
        detail[rows] = view.camera.focal_px[0] ** 2 * np.maximum(cosine, 0.05) / distance**2
    order = np.lexsort((detail, seen.points))
    starts = np.flatnonzero(np.diff(seen.points[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    middle = order[starts + counts // 2]
    reference = np.empty(len(order), np.int64)
    reference[order] = np.repeat(middle, counts)
    return reference


def _plane_affinities(
    points: np.ndarray,
    normals: np.ndarray,
    seen: Observations,
    views: Mapping[int, PosedView],
    base: np.ndarray,
    rows: np.ndarray,
) -> np.ndarray:
    """Return the (K, 2, 2) derivatives of positions in other views by those in the reference."""
    steps = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
    targets = points[seen.points[rows]]
    facing = normals[seen.points[rows]]
    on_plane = np.empty((len(rows), 4, 3))
    for number in np.unique(seen.views[base]):
        chosen = np.flatnonzero(seen.views[base] == number)
        view = views[int(number)]
        start = view.project(targets[chosen])[0]
        height = np.einsum("ij,ij->i", targets[chosen] - view.centre, facing[chosen])
        for k, step in enumerate(steps):
            rays = view.camera.rays(start + step) @ view.rotation
            depth = height / np.einsum("ij,ij->i", rays, facing[chosen])
            on_plane[chosen, k] = view.centre + rays * depth[:, None]
    there = np.empty((len(rows), 4, 2))
    for number in np.unique(seen.views[rows]):
        chosen = np.flatnonzero(seen.views[rows] == number)
        flat = views[int(number)].project(on_plane[chosen].reshape(-1, 3))[0]
        there[chosen] = flat.reshape(-1, 4, 2)
    return np.stack([there[:, 0] - there[:, 1], there[:, 2] - there[:, 3]], axis=2) / 2


def _align(
    images: Mapping[int, np.ndarray],
    seen: Observations,
    base: np.ndarray,
    rows: np.ndarray,
    affine: np.ndarray,
    options: TrackRefinementOptions,
) -> tuple[np.ndarray, np.ndarray]:
    """Align patches of other views with those of the reference: places, and whether they fit."""
    side = 2 * options.radius_px + 1
    grid = np.arange(side + 2.0) - options.radius_px - 1
    x, y = np.meshgrid(grid, grid)
    wide = np.column_stack([x.ravel(), y.ravel()])
    inner = np.column_stack([x[1:-1, 1:-1].ravel(), y[1:-1, 1:-1].ravel()])
    # The middle counts most: what is further away may lie on another surface.
    weights = np.exp(-(inner**2).sum(axis=1) / (2 * (options.radius_px / 1.5) ** 2))
    weights /= weights.sum()
    template = _sample(images, seen.views[base], seen.xy[base][:, None] + wide)
    template = template.reshape(-1, side + 2, side + 2)
    slope_x = (template[:, 1:-1, 2:] - template[:, 1:-1, :-2]).reshape(len(rows), -1) / 2
    slope_y = (template[:, 2:, 1:-1] - template[:, :-2, 1:-1]).reshape(len(rows), -1) / 2
    flat = template[:, 1:-1, 1:-1].reshape(len(rows), -1)
    fixed, spread = _normalised(flat, weights)
    ones = np.ones(len(inner))
    columns = (inner[:, 0], inner[:, 1], ones)
    jacobian = np.stack(
        [slope * column for slope in (slope_x, slope_y) for column in columns], axis=2
    )
    jacobian /= spread[:, None, None]
    jacobian -= np.einsum("p,kpj->kj", weights, jacobian)[:, None]
    # What a change of contrast explains is taken out, too.
    share = np.einsum("kpj,kp,p->kj", jacobian, fixed, weights)
    jacobian -= share[:, None] * fixed[:, :, None]
    weighted = jacobian * weights[:, None]
    hessian = np.einsum("kpi,kpj->kij", jacobian, weighted)
    scale = np.array([options.radius_px] * 2 + [1.0] + [options.radius_px] * 2 + [1.0]) ** 2
    hessian += 1e-6 * np.einsum("kii->k", hessian)[:, None, None] * np.diag(scale)
    solve = np.linalg.pinv(hessian) @ weighted.transpose(0, 2, 1)
    place, warp = seen.xy[rows].copy(), affine.copy()
    active = np.isfinite(warp).all(axis=(1, 2)) & (spread > 1)
    usable = active.copy()
    for _ in range(options.iterations):
        k = np.flatnonzero(active)
        if not len(k):
            break
        where = place[k][:, None] + np.einsum("kij,pj->kpi", warp[k], inner)
        values, _ = _normalised(_sample(images, seen.views[rows[k]], where), weights)
        step = np.einsum("kjp,kp->kj", solve[k], values - fixed[k])
        change = np.stack([step[:, 0:2], step[:, 3:5]], axis=1) + np.eye(2)
        inverse = np.linalg.pinv(change)
        new_warp = warp[k] @ inverse
        moved = np.einsum("kij,kj->ki", new_warp, step[:, [2, 5]])
        warp[k], place[k] = new_warp, place[k] - moved
        active[k] = np.linalg.norm(moved, axis=1) >= options.min_step_px
        lost = np.linalg.norm(place[k] - seen.xy[rows[k]], axis=1) > 2 * options.max_move_px
        active[k[lost]] = usable[k[lost]] = False
    k = np.flatnonzero(usable)
    correlation = np.full(len(rows), -1.0)
    where = place[k][:, None] + np.einsum("kij,pj->kpi", warp[k], inner)
    values, _ = _normalised(_sample(images, seen.views[rows[k]], where), weights)
    correlation[k] = np.einsum("kp,kp,p->k", values, fixed[k], weights)
    moved = np.linalg.norm(place - seen.xy[rows], axis=1)
    good = usable & (moved <= options.max_move_px) & (correlation >= options.min_correlation)
    return place, good


def _normalised(values: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return patches (K, P) with mean 0 and deviation 1, and the deviations they had."""
    values = values - (values @ weights)[:, None]
    spread = np.sqrt((values**2) @ weights)
    return values / np.maximum(spread, 1e-6)[:, None], np.maximum(spread, 1e-6)


def _sample(images: Mapping[int, np.ndarray], views: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Return the values (K, P) of views at positions (K, P, 2)."""
    values = np.empty(xy.shape[:2])
    for number in np.unique(views):
        rows = np.flatnonzero(views == number)
        column, row = xy[rows].astype(np.float32).transpose(2, 0, 1)
        # OpenCV takes maps of any length, but rows of up to 32767 only.
        values[rows] = cv2.remap(
            images[int(number)],
            np.ascontiguousarray(column),
            np.ascontiguousarray(row),
            cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return values
