"""Find and correct images to which the mapping gave a wrong pose.

If the camera moves straight ahead, an image that is registered early, by few points, may get a
wrong place on the path. Only points whose depth comes from other images reveal this error.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Container, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.progress import progress
from .colmap import quiet_pycolmap
from .mapping import MAX_VERIFICATION_ERROR_PX, MIN_ANGLE_DEG, MIN_VERIFIED, adjust

MIN_SPREAD_DEG = MIN_ANGLE_DEG / 2
"""A point tests an image only if the other images' lines of sight to it spread by this angle (root
mean square). Otherwise, its depth came from the tested image itself."""

MIN_GAIN = 1.5
"""An image moves to a new pose if the number of points that agree with it grows by this factor or
more. In trials, the factor was at most 1.01 for correct images, 3 or more for misplaced ones."""

MAX_ROUNDS = 3
"""Images are checked in up to this many rounds, because each correction improves the points."""

MIN_KEPT = 0.9
"""A correction is undone if, after all points are triangulated again, the model has less than this
fraction of its former observations. In trials in which corrections helped, 0.99 remained."""


def correct_places(
    model: Any,
    database: Path,
    folder: Path,
    known_cameras: bool,
    seed: int = 0,
    quiet: bool = True,
) -> Any:
    """Return a `pycolmap.Reconstruction` in which misplaced images have been moved to better poses.

    `database` was used for mapping. After a move, all points are triangulated and adjusted again.
    """
    for _ in range(MAX_ROUNDS):
        with quiet_pycolmap() as pycolmap:
            places = _better_places(pycolmap, model, database, seed, quiet)
            if not places:
                break
            moved = pycolmap.Reconstruction(model)
            for number, place in places.items():
                image = moved.images[number]
                image.frame.set_cam_from_world(image.camera_id, place)
            with tempfile.TemporaryDirectory(prefix="deepdetect-") as space:
                how = pycolmap.IncrementalPipelineOptions(extract_colors=False, random_seed=seed)
                moved = pycolmap.triangulate_points(moved, database, folder, space, options=how)
        if moved.compute_num_observations() < MIN_KEPT * model.compute_num_observations():
            break
        adjust(moved, known_cameras)
        model = moved
    return model


def _better_places(
    pycolmap: Any, model: Any, database: Path, seed: int, quiet: bool
) -> dict[int, Any]:
    """Return, by image number, poses with which more points of other images agree."""
    how = pycolmap.AbsolutePoseEstimationOptions()
    how.ransac.max_error, how.ransac.random_seed = MAX_VERIFICATION_ERROR_PX, seed
    points, found = _Points(model), {}
    with (
        pycolmap.Database.open(database) as opened,
        progress(len(points.seen), "checking places", "image", quiet) as bar,
    ):
        partners = _partners(pycolmap, opened, points.seen)
        for number in points.seen:
            bar.update()
            matches = (
                (other, opened.read_two_view_geometry(number, other).inlier_matches)
                for other in partners[number]
            )
            keypoints, rows = points.matched(number, matches)
            image, places = model.images[number], points.xyz[rows]
            xy = points.keypoints[number][keypoints]
            agreeing = partial(_agreeing, image.camera, xy, places)
            needed = max(MIN_VERIFIED, MIN_GAIN * agreeing(image.cam_from_world()))
            if len(rows) < needed:
                continue
            estimate = pycolmap.estimate_and_refine_absolute_pose(xy, places, image.camera, how)
            if estimate and agreeing(estimate["cam_from_world"]) >= needed:
                found[number] = estimate["cam_from_world"]
    return found


class _Points:
    """The points of a model, and which keypoints of which images see them.

    `xyz` (P, 3) are positions of points. For each image number, `keypoints` holds (K, 2) pixels,
    and `seen` the (K,) indices of the points that these keypoints see, or -1.
    """

    def __init__(self, model: Any) -> None:
        row_of = {number: row for row, number in enumerate(model.points3D)}
        places = [point.xyz for point in model.points3D.values()]
        self.xyz = np.array(places).reshape(-1, 3)
        self.keypoints, self.seen, self._sights = {}, {}, {}
        # For each point, the number and the sum of the lines of sight of the images that see it.
        self._counts, self._sums = np.zeros(len(self.xyz)), np.zeros_like(self.xyz)
        for number in model.reg_image_ids():
            image = model.images[number]
            self.keypoints[number] = np.array([k.xy for k in image.points2D]).reshape(-1, 2)
            rows = [row_of.get(k.point3D_id, -1) for k in image.points2D]
            self.seen[number] = np.array(rows, np.int64)
            own = np.unique(self.seen[number][self.seen[number] >= 0])
            sights = self.xyz[own] - image.projection_center()
            sights /= np.linalg.norm(sights, axis=1, keepdims=True)
            self._sights[number] = own, sights
            self._counts[own] += 1
            self._sums[own] += sights

    def matched(
        self, number: int, matches: Iterable[tuple[int, np.ndarray]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return matched indices: keypoints of an image, points with depth from other images.

        `matches` are other images, each with (M, 2) indices of matching keypoints in both images.
        """
        own, sights = self._sights[number]
        counts, sums = self._counts.copy(), self._sums.copy()
        counts[own] -= 1
        sums[own] -= sights
        # The more widely unit vectors spread, the shorter their mean is.
        lengths = np.linalg.norm(sums, axis=1) / np.maximum(counts, 1)
        well = (counts > 1) & (lengths < np.cos(np.radians(MIN_SPREAD_DEG)))
        found = [np.empty(0, np.int64)]
        for other, inliers in matches:
            pairs = np.asarray(inliers, np.int64).reshape(-1, 2)
            rows = self.seen[other][pairs[:, 1]]
            kept = (rows >= 0) & well[rows]
            found.append(pairs[kept, 0] * len(self.xyz) + rows[kept])
        keypoints, rows = np.divmod(np.unique(np.concatenate(found)), max(len(self.xyz), 1))
        return keypoints, rows


def _partners(pycolmap: Any, database: Any, images: Container[int]) -> dict[int, list[int]]:
    """Return, for each image, the images with which it has verified matches, all by number."""
    partners = defaultdict[int, list[int]](list)
    for pair, count in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if count >= MIN_VERIFIED and first in images and second in images:
            partners[first].append(second)
            partners[second].append(first)
    return partners


def _agreeing(camera: Any, xy: np.ndarray, points: np.ndarray, pose: Any) -> int:
    """Count the points (K, 3) that a camera with this pose sees at their keypoints `xy` (K, 2)."""
    local = points @ pose.rotation.matrix().T + pose.translation
    errors = np.linalg.norm(camera.img_from_cam(local) - xy, axis=1)
    return int(((errors < MAX_VERIFICATION_ERROR_PX) & (local[:, 2] > 0)).sum())
