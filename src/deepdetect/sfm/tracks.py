"""Tracks at sub-pixel positions: patches of one image of each, aligned in all others.

A keypoint is where its own image has a maximum, which noise and the angle of view move. Once the
cameras are known, the image that sees a point from the middle tells the others what to look for: a
patch of the surface, warped as they see it. Lindenberger et al., "Pixel-Perfect Structure-from-
Motion with Featuremetric Refinement", 2021, align features of a network instead.
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
from ..geometry.camera import PosedView
from ..io.image import load_image, luma
from ..reconstruction.subpixel import align_patches, spread_corners
from .colmap import PIXEL_CENTRE, quiet_pycolmap
from .mapping import RegisteredImage, SparseModel, read_sparse_model

PATCH_RADIUS_PX = 6
"""Of the patches that are aligned."""

MAX_SHIFT_PX = 2.5
"""From where the model sees a point to where the patch is found."""

BLUR_SIGMA_PX = 0.7
"""Of the images before: cubic interpolation at other phases dampens noise differently."""

MIN_FACING = 0.3
"""Cosine of the angle between the normal of a surface and the line of sight of an image that is
asked for it."""

MAX_GROWTH = 7.0
"""Of the area of a patch from one image to another, or the other way round."""

MIN_COMMON_POINTS = 10
"""Of two images, for points of one to be sought in the other."""

DENSE_CELLS = 4500
"""Of an image, for dense tracks: as many corners at most."""

MIN_DISTANCE_PX = 3
"""From a new track to those that its image is part of already."""

MIN_DENSE_VIEWS = 3
"""Of a dense track: two images only agree with themselves."""

CACHED_IMAGES, CACHED_PIXELS = 8, 1e8
"""That are kept in memory, of seven bytes each, as many images as fit but at least so many:
following references share their neighbours."""


class Surfaces(NamedTuple):
    """What is sought of an image: (K, 2) whole pixels, and the planes (K, 3), (K, 3) they lie on.

    Normals are of length 1 and towards the image, in the frame of the model, as the points are.
    """

    pixels: np.ndarray
    points: np.ndarray
    normals: np.ndarray


def refine_tracks(model: Any, folder: Path, quiet: bool = True) -> None:
    """Put refined tracks in place of those of a `pycolmap.Reconstruction`; cameras stay.

    Each point keeps the image that sees it from the middle, at a whole pixel, and is aligned in the
    others of its track. Points have the colour of their pixel. `quiet` shows no bar.
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
    """Add tracks of `DENSE_POINT`, with the view that they are seen from, to those of a model.

    An image gives the best corner in each cell of a grid, where tracks of earlier images have
    none: what all of them show is matched from one image only. The model's own tracks, which are
    shorter, are aligned again where no other is near.
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
    """Return by image the points that it sees from the middle of their track, and their rows.

    Their surfaces are taken to face that middle.
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
    """Tracks of a model, as they are found."""

    def __init__(self, sparse: SparseModel, folder: Path) -> None:
        self.sparse, self.images, self.folder = sparse, [*sparse.images.values()], folder
        self.numbers = {name: number for number, name in enumerate(sparse.images)}
        self.points = [np.empty((0, 3))]
        self.colors = [np.empty((0, 3), np.uint8)]
        self.count = 0
        none = np.empty(0, np.int64), np.empty((0, 2))
        self.seen = [[none] for _ in self.images]  # rows of points, and pixels, by image
        largest = max(math.prod(image.intrinsics.size) for image in self.images)
        self.read = lru_cache(max(CACHED_IMAGES, int(CACHED_PIXELS / largest)))(self._read)

    def corners(self, name: str, points: np.ndarray) -> Surfaces:
        """Choose those of the dense points of an image that become tracks."""
        image = self.images[self.numbers[name]]
        xy = image.intrinsics.from_pinhole(image.view.project(points["points"])[0])
        pixels = np.rint(xy).astype(np.int64).clip(0, np.array(image.intrinsics.size) - 1)
        rows = self.free(name, pixels)
        rows = rows[spread_corners(luma(self.read(name)[0]), pixels[rows], DENSE_CELLS)]
        places, normals = (points[kind][rows].astype(np.float64) for kind in ("points", "normals"))
        return Surfaces(pixels[rows], places, normals)

    def free(self, name: str, pixels: np.ndarray) -> np.ndarray:
        """Return rows of (K, 2) pixels of an image that are not near its tracks."""
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
        """Seek surfaces of an image in others; those that enough images see become points.

        They are sought in the images of their `tracks`, rows of the model's points, or in all.
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
        """Return rows of the surfaces that another image shows, and their pixels there."""
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
        xy, converged = align_patches(
            (self.read(image.view.name)[1], self.read(other.view.name)[1]),
            pixels[rows],
            np.ascontiguousarray(start[rows, :2]),
            affinities[rows],
            radius_px=PATCH_RADIUS_PX,
            max_shift_px=MAX_SHIFT_PX,
        )
        return rows[converged], xy[converged]

    def write(self, model: Any) -> None:
        """Put the tracks in place of those of a `pycolmap.Reconstruction`."""
        self.read.cache_clear()  # the adjustment that follows needs the memory
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
        """Return an image (H, W, 3), and its blurred grey values (H, W) float32."""
        rgb = load_image(self.folder / name, max_megapixels=np.inf)
        return rgb, cv2.GaussianBlur(luma(rgb).astype(np.float32), (0, 0), BLUR_SIGMA_PX)
