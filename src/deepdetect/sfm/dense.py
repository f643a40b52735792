"""Dense points from photographs with known cameras.

Each photograph in turn is the reference. It is rectified with its best neighbours, and matched with
them row by row (`matching.guided.rectified`); `fusion` makes points of the matches.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .._shared.opencv import cv2
from ..geometry.camera import Camera
from ..geometry.posed_view import PosedView, relative_fundamental
from ..io.image import load_image, luma
from ..matching.guided.rectified import match_by_rectification
from .fusion import DenseOptions, DensePoints, angles_between, fuse_matches
from .lens import Lens
from .mapping import SparseModel


@dataclass(frozen=True, eq=False)
class Neighbour:
    """A photograph that a reference is matched with.

    Attributes:
        view: its camera.
        lens: the same with its distortion.
        points0, points1: (K, 2) sparse matches, in pixels of the pinhole cameras of the reference
            and of this one.
    """

    view: PosedView
    lens: Lens
    points0: np.ndarray
    points1: np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """A photograph whose pixels become points, and those that it is matched with."""

    view: PosedView
    lens: Lens
    neighbours: tuple[Neighbour, ...]


def find_references(sparse: SparseModel, options: DenseOptions = DenseOptions()) -> list[Reference]:
    """Choose the neighbours of each photograph: those that share many points at a good angle.

    Args:
        sparse: cameras and points.
        options: how many.

    Returns:
        The photographs that have enough neighbours, those that see most points first.
    """
    rows = {number: np.flatnonzero(sparse.seen.views == number) for number in sparse.views}
    found = []
    for number in sorted(rows, key=lambda number: -len(rows[number])):
        scored = []
        for other in rows:
            if other == number:
                continue
            common, own, its = np.intersect1d(
                sparse.seen.points[rows[number]],
                sparse.seen.points[rows[other]],
                return_indices=True,
            )
            if len(common) < options.min_common_points:
                continue
            score = _angle_weights(
                sparse.points[common],
                sparse.views[number].centre,
                sparse.views[other].centre,
                options,
            ).sum()
            neighbour = Neighbour(
                sparse.views[other],
                sparse.lenses[other],
                sparse.seen.xy[rows[number][own]],
                sparse.seen.xy[rows[other][its]],
            )
            scored.append((float(score), neighbour))
        scored.sort(key=lambda each: -each[0])
        best = tuple(neighbour for _, neighbour in scored[: options.neighbours])
        if len(best) + 1 >= options.min_views:
            found.append(Reference(sparse.views[number], sparse.lenses[number], best))
    return found


def _angle_weights(
    points: np.ndarray, centre0: np.ndarray, centre1: np.ndarray, options: DenseOptions
) -> np.ndarray:
    """Return what each point says for matching two views, by its triangulation angle."""
    angle = np.degrees(angles_between(points - centre0, points - centre1))
    weight = np.minimum(angle / options.ideal_angle_deg, 1) ** 1.5
    return np.asarray(weight * np.minimum(options.max_angle_deg / np.maximum(angle, 1e-9), 1) ** 2)


def dense_points(
    folder: Path, reference: Reference, options: DenseOptions = DenseOptions()
) -> DensePoints:
    """Match a reference with its neighbours, and return the points that enough of them agree on.

    Args:
        folder: of the photographs.
        reference: with its neighbours.
        options: how.

    Raises:
        ImageError: a photograph cannot be read any more.
    """
    rgb, view, scale = _prepared(folder, reference.view, reference.lens, options)
    gray = luma(rgb)
    height, width = gray.shape
    y, x = np.mgrid[0 : height : options.stride_px, 0 : width : options.stride_px]
    xy = np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)
    views, matches = [], []
    for neighbour in reference.neighbours:
        other, its_view, its_scale = _prepared(folder, neighbour.view, neighbour.lens, options)
        found = match_by_rectification(
            gray,
            luma(other),
            xy,
            _scaled(neighbour.points0, scale),
            _scaled(neighbour.points1, its_scale),
            relative_fundamental(view, its_view),
            exact=True,
        )
        if found is None:
            continue
        places = np.full((len(xy), 2), np.nan)
        places[found[1].indices0] = found[1].points1
        views.append(its_view)
        matches.append(places)
    points, errors, counts = fuse_matches(view, xy, views, matches, options)
    kept = np.flatnonzero(counts)
    return DensePoints(
        points[kept].astype(np.float32),
        rgb[y.ravel()[kept], x.ravel()[kept]],
        errors[kept].astype(np.float32),
        counts[kept].astype(np.uint8),
    )


def _prepared(
    folder: Path, view: PosedView, lens: Lens, options: DenseOptions
) -> tuple[np.ndarray, PosedView, float]:
    """Read a photograph without its distortion, at most `max_side_px` long; camera and scale."""
    rgb = lens.undistort(load_image(folder / view.name))
    smaller = limited_view(view, options)
    size = smaller.camera.size
    if size != view.camera.size:
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return rgb, smaller, size[0] / view.camera.size[0]


def limited_view(view: PosedView, options: DenseOptions) -> PosedView:
    """Return a view of at most `max_side_px`."""
    width, height = view.camera.size
    scale = options.max_side_px / max(width, height)
    if scale >= 1:
        return view
    size = (round(width * scale), round(height * scale))
    across, down = size[0] / width, size[1] / height
    (fx, fy), (cx, cy) = view.camera.focal_px, view.camera.centre
    centre = ((cx + 0.5) * across - 0.5, (cy + 0.5) * down - 0.5)
    return replace(view, camera=Camera(size, (fx * across, fy * down), centre))


def _scaled(xy: np.ndarray, scale: float) -> np.ndarray:
    """Return positions in an image that has been scaled."""
    return np.asarray((xy + 0.5) * scale - 0.5)
