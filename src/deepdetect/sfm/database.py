"""COLMAP's database: images, cameras, keypoints and matches.

COLMAP's centre of the first pixel is (0.5, 0.5): half a pixel is added to all positions. Its scale
is sigma, half of OpenCV's diameter, and its orientation is in radians, clockwise as OpenCV's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ..batch.extraction import ROOT_SIFT_NORM
from ..batch.pair_list import Pair
from ..features.keypoints import UNSET_ANGLE, Keypoints
from .colmap import PIXEL_CENTRE, quiet_pycolmap
from .intrinsics import CameraIntrinsics

SIFT_NUMBERS = 128


def write_database(
    path: Path,
    images: Mapping[str, tuple[Keypoints, CameraIntrinsics]],
    matches: Mapping[Pair, np.ndarray],
) -> None:
    """Write a new database of COLMAP to a file that does not exist, or is empty.

    Keypoints with sizes have four columns (x, y, scale, orientation), others two. Descriptors are
    written where they are SIFT's.

    Args:
        path: the file.
        images: by their path below their folder; those with the same object of intrinsics share a
            camera.
        matches: (K, 2) rows of keypoints by the names of the two images.
    """
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(path) as database:
        cameras: dict[int, tuple[int, int]] = {}  # camera and rig by the object
        numbers: dict[str, int] = {}
        for name, (points, intrinsics) in images.items():
            if id(intrinsics) not in cameras:
                camera = intrinsics.colmap_camera()
                camera.camera_id = database.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                cameras[id(intrinsics)] = camera.camera_id, database.write_rig(rig)
            camera_id, rig_id = cameras[id(intrinsics)]
            row = pycolmap.Image(name=name, camera_id=camera_id)
            row.image_id = numbers[name] = database.write_image(row)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(row.data_id)
            database.write_frame(frame)
            columns = [points.xy + PIXEL_CENTRE]
            if points.sizes is not None:
                columns += [points.sizes[:, None] / 2, orientations_of(points)[:, None]]
            keypoints = np.ascontiguousarray(np.hstack(columns), np.float32)
            database.write_keypoints(row.image_id, keypoints)
            descriptors = sift_bytes(points)
            if descriptors is not None:
                described = pycolmap.FeatureDescriptors(
                    pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(descriptors)
                )
                database.write_descriptors(row.image_id, described)
        for (name0, name1), rows in matches.items():
            found = np.ascontiguousarray(rows, np.uint32).reshape(-1, 2)
            database.write_matches(numbers[name0], numbers[name1], found)


def orientations_of(points: Keypoints) -> np.ndarray:
    """Return (N,) orientations in radians, clockwise; 0 where there are none."""
    if points.angles is None:
        return np.zeros(len(points), np.float32)
    return np.deg2rad(np.where(points.angles == UNSET_ANGLE, 0, points.angles))


def sift_bytes(keypoints: Keypoints) -> np.ndarray | None:
    """Return descriptors as SIFT's (N, 128) uint8, or None where they are of another kind.

    Those of length 1 are multiplied by 512, as SIFT does it.
    """
    found = keypoints.descriptors
    if found is None or found.shape[1] != SIFT_NUMBERS:
        return None
    if found.dtype == np.uint8:
        return found
    if found.size and found.min() < 0:
        return None
    return np.rint(found * ROOT_SIFT_NORM).clip(0, 255).astype(np.uint8)
