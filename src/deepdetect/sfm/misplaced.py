"""Images that the mapping has put in a wrong place, and their right one.

An image that comes early is placed by few points. Where a camera moves straight ahead, matches that
are wrong along the line of motion agree with many places on it, and a wrong one stays: the points
that the image itself gave their depth agree with it. Those that others see without it do not.
"""

from __future__ import annotations

import tempfile
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .colmap import quiet_pycolmap
from .mapping import MAX_VERIFICATION_ERROR_PX, MIN_VERIFIED, adjust

MIN_OTHERS = 2
"""Images that see a point beside the one that is checked: its place rests on them alone."""

MIN_GAIN = 1.5
"""Points that agree with another place, in those that agree with the one of the model. Of images
that are in their place it is 1 within a hundredth, of others it was 3 and more."""

MAX_ROUNDS = 3
"""Of checks: with each image that is put right, the points by which others are checked get
better."""


def correct_places(model: Any, database: Path, folder: Path, known_cameras: bool, seed: int) -> Any:
    """Return a model of pycolmap in which all images are where the points of the others say.

    The database is that of the mapping. If an image is put elsewhere, all points are made anew, and
    cameras and points adjusted.
    """
    for _ in range(MAX_ROUNDS):
        with quiet_pycolmap() as pycolmap:
            places = _better_places(pycolmap, model, database, seed)
            if not places:
                break
            for number, place in places.items():
                image = model.images[number]
                image.frame.set_cam_from_world(image.camera_id, place)
            with tempfile.TemporaryDirectory(prefix="deepdetect-") as space:
                how = pycolmap.IncrementalPipelineOptions(extract_colors=False, random_seed=seed)
                model = pycolmap.triangulate_points(model, database, folder, space, options=how)
        adjust(model, known_cameras)
    return model


def _better_places(pycolmap: Any, model: Any, database: Path, seed: int) -> dict[int, Any]:
    """Return the poses of those images that more points of others agree with, by their numbers."""
    how = pycolmap.AbsolutePoseEstimationOptions()
    how.ransac.max_error, how.ransac.random_seed = MAX_VERIFICATION_ERROR_PX, seed
    row_of = {number: row for row, number in enumerate(model.points3D)}
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    lengths = np.array([point.track.length() for point in model.points3D.values()], np.int64)
    seen = {
        number: np.array([row_of.get(p.point3D_id, -1) for p in model.images[number].points2D])
        for number in model.reg_image_ids()
    }
    found = {}
    with pycolmap.Database.open(database) as opened:
        partners = _partners(pycolmap, opened, seen)
        for number, own in seen.items():
            matched = np.concatenate(
                [np.empty((0, 2), np.int64)]
                + [_matched(opened, number, other, seen[other]) for other in partners[number]]
            )
            keypoints, rows = np.unique(matched, axis=0).T
            others = lengths[rows] - np.isin(rows, own[own >= 0])
            keypoints, rows = (each[others >= MIN_OTHERS] for each in (keypoints, rows))
            if len(rows) < MIN_VERIFIED:
                continue
            image = model.images[number]
            xy = np.array([point.xy for point in image.points2D])[keypoints]
            estimate = pycolmap.estimate_and_refine_absolute_pose(
                xy, points[rows], image.camera, how
            )
            if estimate is None:
                continue
            place = estimate["cam_from_world"]
            before, after = (
                _agreeing(image.camera, pose, xy, points[rows])
                for pose in (image.cam_from_world(), place)
            )
            if after >= max(MIN_VERIFIED, MIN_GAIN * before):
                found[number] = place
    return found


def _partners(
    pycolmap: Any, database: Any, images: Mapping[int, np.ndarray]
) -> dict[int, list[int]]:
    """Return with which of the images each has verified matches."""
    partners = defaultdict[int, list[int]](list)
    for pair, count in zip(*database.read_two_view_geometry_num_inliers(), strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair)
        if count >= MIN_VERIFIED and first in images and second in images:
            partners[first].append(second)
            partners[second].append(first)
    return partners


def _matched(database: Any, number: int, other: int, seen: np.ndarray) -> np.ndarray:
    """Return (K, 2) keypoints of an image, and the rows of the points another has them matched to.

    `seen` has the row of the point at each keypoint of the other image, or -1.
    """
    matches = np.asarray(database.read_two_view_geometry(number, other).inlier_matches, np.int64)
    found = np.column_stack([matches[:, 0], seen[matches[:, 1]]])
    return found[found[:, 1] >= 0]


def _agreeing(camera: Any, pose: Any, xy: np.ndarray, points: np.ndarray) -> int:
    """Count points that a camera at a pose sees where (K, 2) keypoints are."""
    local = points @ pose.rotation.matrix().T + pose.translation
    errors = np.linalg.norm(camera.img_from_cam(local) - xy, axis=1)
    return int(((errors < MAX_VERIFICATION_ERROR_PX) & (local[:, 2] > 0)).sum())
