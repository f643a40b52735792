"""Refine tracks to sub-pixel accuracy: a patch of one image is aligned in all other images.

Noise and the viewing angle move the keypoints of each image. Once the cameras are known, a patch of
the image that sees a point from the middle of all directions is warped to the other images and
aligned there. Lindenberger et al., "Pixel-Perfect Structure-from-Motion with Featuremetric
Refinement", 2021, align features of a network instead of grey values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._shared.opencv import cv2
from .._shared.progress import progress
from ..geometry.alignment import Alignment, align_patches
from ..geometry.camera import PosedView
from ..io.image import load_image, luma
from ..reconstruction.subpixel import CONVERGENCE_PX, spread_corners
from .colmap import PIXEL_CENTRE, quiet_pycolmap
from .mapping import RegisteredImage, SparseModel, read_sparse_model

PATCH_RADIUS_PX, MAX_SHIFT_PX = 6, 2.5
"""Radius of the patches that are aligned, and the largest distance that alignment moves them from
the projections of their points. Chosen by hand."""

BLUR_SIGMA_PX = 0.7
"""Images are blurred with this sigma before patches are aligned. Without the blur, cubic
interpolation dampens noise by an amount that depends on the sub-pixel position."""

MIN_FACING, MAX_GROWTH, MIN_COMMON_POINTS = 0.3, 7.0, 10
"""A patch is searched for in another image only if the cosine of the angle between its normal and
the direction to that camera exceeds `MIN_FACING`, its area there changes by a factor below
`MAX_GROWTH`, and the images share at least `MIN_COMMON_POINTS` points. Chosen by hand."""

DENSE_CELLS, MIN_DISTANCE_PX = 4500, 3
"""An image is divided into about `DENSE_CELLS` squares. In each, at most one dense point begins a
track, farther than `MIN_DISTANCE_PX` from all earlier tracks in the image. Chosen by hand."""

MIN_DENSE_VIEWS = 3
"""A track of a dense point needs at least this many images: a third one checks the match of two."""

CACHED_IMAGES, CACHED_PIXELS = 8, 1e8
"""Images are cached, because successive images share neighbours: at least `CACHED_IMAGES` images,
and more as long as they have at most `CACHED_PIXELS` pixels together (seven bytes each)."""


class Surfaces(NamedTuple):
    """Small plane patches around pixels of an image, which are to be found in other images.

    `pixels` (K, 2) are integers. `points` (K, 3) and `normals` (K, 3) are in the model's frame. The
    normals are unit vectors that point towards the camera of the image.
    """

    pixels: np.ndarray
    points: np.ndarray
    normals: np.ndarray


def refine_tracks(model: Any, folder: Path, quiet: bool = True) -> None:
    """Replace the tracks of a `pycolmap.Reconstruction` by refined ones. Cameras stay fixed.

    The image that sees a point from the middle of all directions gives the point's colour and a
    patch to align in the other images of the track. With `quiet`, no progress bar is shown.
    """
    sparse = read_sparse_model(model)
    tracks = _Tracks(sparse, folder)
    with progress(len(sparse.images), "aligning tracks", "image", quiet) as bar:
        for name, (surfaces, rows) in _central_views(sparse).items():
            tracks.add(name, surfaces, rows)
            bar.update()
    tracks.write(model)


def add_dense_tracks(
    model: Any, folder: Path, fused: Iterable[tuple[PosedView, np.ndarray]]
) -> None:
    """Add tracks of dense points to those of a model.

    `fused` are views, each with the `DENSE_POINT` array of its depth map. The best corner in each
    grid cell of an image begins a track, unless a track of an earlier image is near. The model's
    own tracks, which are shorter, are aligned again where no new track is near.
    """
    sparse = read_sparse_model(model)
    tracks = _Tracks(sparse, folder)
    for view, points in fused:
        tracks.add(view.name, tracks.corners(view.name, points), min_views=MIN_DENSE_VIEWS)
    central = _central_views(sparse)
    free = {name: tracks.free(name, surfaces.pixels) for name, (surfaces, _) in central.items()}
    for name, (surfaces, rows) in central.items():
        left = Surfaces(*(each[free[name]] for each in surfaces))
        tracks.add(name, left, rows[free[name]])
    tracks.write(model)


def _central_views(sparse: SparseModel) -> dict[str, tuple[Surfaces, np.ndarray]]:
    """Return, by image, the points that the image sees most centrally, and their indices.

    The image nearest to the mean line of sight to a point sees it most centrally. The surface at
    the point is assumed to face the mean direction.
    """
    images = [*sparse.images.values()]
    rows = np.concatenate([image.points for image in images])
    owners = np.repeat(np.arange(len(images)), [len(image.points) for image in images])
    sights = sparse.points[rows] - np.array([image.view.centre for image in images])[owners]
    sights /= np.linalg.norm(sights, axis=1, keepdims=True)
    middles = np.zeros_like(sparse.points)
    np.add.at(middles, rows, sights)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    order = np.lexsort((-(sights * middles[rows]).sum(axis=1), rows))
    best = order[np.flatnonzero(np.diff(rows[order], prepend=-1))]
    pixels = np.concatenate([image.intrinsics.from_pinhole(image.xy) for image in images])
    found = {}
    for number, image in enumerate(images):
        own = best[owners[best] == number]
        points = rows[own]
        whole = np.rint(pixels[own]).astype(np.int64)
        surfaces = Surfaces(whole, sparse.points[points], -middles[points])
        found[image.view.name] = surfaces, points
    return found


class _Tracks:
    """The refined tracks of a model that have been found so far."""

    def __init__(self, sparse: SparseModel, folder: Path) -> None:
        self.sparse, self.images, self.folder = sparse, [*sparse.images.values()], folder
        self.numbers = {name: number for number, name in enumerate(sparse.images)}
        self.points = [np.empty((0, 3))]
        self.colors = [np.empty((0, 3), np.uint8)]
        self.count = 0
        none = np.empty(0, np.int64), np.empty((0, 2))
        self.seen = [[none] for _ in self.images]  # per image: indices of points, their pixels
        largest = max(math.prod(image.intrinsics.size) for image in self.images)
        self.read = lru_cache(max(CACHED_IMAGES, int(CACHED_PIXELS / largest)))(self._read)

    def corners(self, name: str, points: np.ndarray) -> Surfaces:
        """Choose dense points that begin tracks: the strongest corner in each grid square."""
        image = self.images[self.numbers[name]]
        xy = image.intrinsics.from_pinhole(image.view.project(points["points"])[0])
        pixels = np.rint(xy).astype(np.int64).clip(0, np.array(image.intrinsics.size) - 1)
        rows = self.free(name, pixels)
        rows = rows[spread_corners(luma(self.read(name)[0]), pixels[rows], DENSE_CELLS)]
        places, normals = (points[kind][rows].astype(np.float64) for kind in ("points", "normals"))
        return Surfaces(pixels[rows], places, normals)

    def free(self, name: str, pixels: np.ndarray) -> np.ndarray:
        """Return the indices of those pixels (K, 2) of an image that are near no track."""
        number = self.numbers[name]
        free = np.ones(self.images[number].intrinsics.size[::-1], np.uint8)
        for _, xy in self.seen[number]:
            column, row = np.rint(xy).astype(np.int64).T
            free[row, column] = 0
        free = cv2.erode(free, np.ones((2 * MIN_DISTANCE_PX + 1,) * 2, np.uint8))
        return np.flatnonzero(free[pixels[:, 1], pixels[:, 0]])

    def add(
        self, name: str, wanted: Surfaces, tracks: np.ndarray | None = None, min_views: int = 2
    ) -> None:
        """Align patches of an image in other images, and turn them into points with tracks.

        A patch becomes a point if at least `min_views` images show it, including its own. If
        `tracks` (K,) gives each patch's point of the model, only images that see the point are
        searched.
        """
        own = self.numbers[name]
        pixels, points, _ = wanted
        found = [(own, np.arange(len(pixels)), pixels.astype(np.float64))]
        for k, common in enumerate(self.sparse.common_points(self.images[own])):
            if k == own or common < MIN_COMMON_POINTS:
                continue
            rows = np.arange(len(pixels))
            if tracks is not None:
                rows = rows[np.isin(tracks, self.images[k].points)]
            if not len(rows):
                continue
            some = Surfaces(*(each[rows] for each in wanted))
            at, xy = self._aligned(self.images[own], self.images[k], some)
            found.append((k, rows[at], xy))
        views = np.bincount(np.concatenate([rows for _, rows, _ in found]), minlength=len(pixels))
        kept = views >= min_views
        new = self.count + np.cumsum(kept) - 1
        for k, rows, xy in found:
            self.seen[k].append((new[rows[kept[rows]]], xy[kept[rows]]))
        self.count += int(kept.sum())
        self.points.append(points[kept])
        column, row = pixels[kept].T
        self.colors.append(self.read(name)[0][row, column])

    def _aligned(
        self, image: RegisteredImage, other: RegisteredImage, wanted: Surfaces
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of the patches that are found in another image, and their pixels."""
        pixels, points, normals = wanted
        view, seen = image.view, []
        ahead = ((points - view.centre) * normals).sum(axis=1)
        for step in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            rays = view.camera.rays(image.intrinsics.to_pinhole(pixels + step)) @ view.rotation
            places = view.centre + rays * (ahead / (rays * normals).sum(axis=1))[:, None]
            xy, depth = other.view.project(places)
            seen.append(np.column_stack([other.intrinsics.from_pinhole(xy), depth]))
        start, right, left, below, above = np.array(seen)
        affinities = np.stack([right - left, below - above], axis=2)[:, :2] / 2
        sight = other.view.centre - points
        facing = (sight * normals).sum(axis=1) / np.linalg.norm(sight, axis=1)
        growth = np.linalg.det(affinities)
        rows = np.flatnonzero(
            (np.min(seen, axis=0)[:, 2] > 0)
            & (facing > MIN_FACING)
            & (growth > 1 / MAX_GROWTH)
            & (growth < MAX_GROWTH)
            & ((start[:, :2] >= 0) & (start[:, :2] < other.intrinsics.size)).all(axis=1)
        )
        grays = self.read(image.view.name)[1], self.read(other.view.name)[1]
        given = pixels[rows], np.ascontiguousarray(start[rows, :2]), affinities[rows]
        how = Alignment(PATCH_RADIUS_PX, MAX_SHIFT_PX, CONVERGENCE_PX)
        found = align_patches(grays, *given, how)
        return rows[found.converged], found.points1[found.converged]

    def write(self, model: Any) -> None:
        """Replace the tracks of a `pycolmap.Reconstruction` by the tracks found here."""
        self.read.cache_clear()  # frees memory for the next adjustment
        with quiet_pycolmap() as pycolmap:
            numbers = {image.name: number for number, image in model.images.items()}
            model.delete_all_points2D_and_points3D()
            tracks = [pycolmap.Track() for _ in range(self.count)]
            for image, seen in zip(self.images, self.seen, strict=True):
                number = numbers[image.view.name]
                rows = np.concatenate([rows for rows, _ in seen])
                xy = np.concatenate([xy for _, xy in seen]) + PIXEL_CENTRE
                model.images[number].points2D = pycolmap.Point2DList(map(pycolmap.Point2D, xy))
                for place, row in enumerate(rows):
                    tracks[row].add_element(number, place)
            points, colors = np.concatenate(self.points), np.concatenate(self.colors)
            for point, track, color in zip(points, tracks, colors, strict=True):
                model.add_point3D(point, track, color)

    def _read(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return an image, (H, W, 3) uint8, and its blurred grey values, (H, W) float32."""
        rgb = load_image(self.folder / name, max_megapixels=np.inf)
        return rgb, cv2.GaussianBlur(luma(rgb).astype(np.float32), (0, 0), BLUR_SIGMA_PX)
