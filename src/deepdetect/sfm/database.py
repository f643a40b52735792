"""COLMAP's database: images, cameras, keypoints and matches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..batch.pair_list import Pair
from .colmap import PIXEL_CENTRE, quiet_pycolmap
from .intrinsics import CameraIntrinsics


@dataclass(frozen=True, eq=False)
class DatabaseImage:
    """An image in the database.

    Attributes:
        name: its path below the folder of the images.
        intrinsics: of its camera; images with the same object share one.
        xy: (N, 2) keypoints, centre of the first pixel (0, 0).
        scales: (N,) sigma in pixels, or None.
        orientations: (N,) radians, clockwise; with scales only.
        descriptors: (N, 128) uint8 of SIFT, or None.
    """

    name: str
    intrinsics: CameraIntrinsics
    xy: np.ndarray
    scales: np.ndarray | None = None
    orientations: np.ndarray | None = None
    descriptors: np.ndarray | None = None


def write_database(
    path: Path, images: Sequence[DatabaseImage], matches: Mapping[Pair, np.ndarray]
) -> None:
    """Write a new database of COLMAP.

    Each image is a frame of its own, of a rig with its camera alone.

    Args:
        path: the file, which must not exist or be empty.
        images: the images.
        matches: (K, 2) rows of keypoints by the names of the two images.

    Raises:
        MissingExtraError: pycolmap is not installed.
    """
    with quiet_pycolmap() as pycolmap, pycolmap.Database.open(path) as database:
        cameras: dict[int, tuple[int, int]] = {}  # camera and rig by the object
        numbers: dict[str, int] = {}
        for image in images:
            if id(image.intrinsics) not in cameras:
                camera = image.intrinsics.colmap_camera()
                camera.camera_id = database.write_camera(camera)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(camera.sensor_id)
                cameras[id(image.intrinsics)] = camera.camera_id, database.write_rig(rig)
            camera_id, rig_id = cameras[id(image.intrinsics)]
            row = pycolmap.Image(name=image.name, camera_id=camera_id)
            row.image_id = numbers[image.name] = database.write_image(row)
            frame = pycolmap.Frame()
            frame.rig_id = rig_id
            frame.add_data_id(row.data_id)
            database.write_frame(frame)
            columns = [image.xy + PIXEL_CENTRE]
            if image.scales is not None and image.orientations is not None:
                columns += [image.scales[:, None], image.orientations[:, None]]
            keypoints = np.ascontiguousarray(np.hstack(columns), np.float32)
            database.write_keypoints(row.image_id, keypoints)
            if image.descriptors is not None:
                described = pycolmap.FeatureDescriptors(
                    pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(image.descriptors)
                )
                database.write_descriptors(row.image_id, described)
        for (name0, name1), rows in matches.items():
            found = np.ascontiguousarray(rows, np.uint32).reshape(-1, 2)
            database.write_matches(numbers[name0], numbers[name1], found)
