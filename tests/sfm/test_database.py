from __future__ import annotations

from pathlib import Path

import numpy as np

from deepdetect.features.keypoints import Keypoints
from deepdetect.geometry.camera import Camera
from deepdetect.sfm.database import write_database
from deepdetect.sfm.intrinsics import CameraIntrinsics


def test_colmap_reads_what_is_written(pycolmap, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    shared = CameraIntrinsics.of_camera(Camera((640, 480), 500.0))
    own = CameraIntrinsics.initial((320, 240))
    names = ["a b.jpg", "sub/ü.jpg", "c.jpg"]
    images = {
        name: (Keypoints(rng.uniform(0, 200, (20, 2)), np.ones(20), camera.size), camera)
        for name, camera in zip(names, (shared, shared, own), strict=True)
    }
    rows = np.array([[0, 3], [5, 1]])
    write_database(tmp_path / "d.db", images, {("c.jpg", "a b.jpg"): rows})
    with pycolmap.Database.open(tmp_path / "d.db") as database:
        found = {image.name: image for image in database.read_all_images()}
        assert set(found) == set(names)
        assert database.num_cameras() == 2
        assert database.num_frames() == 3
        assert found["a b.jpg"].camera_id == found["sub/ü.jpg"].camera_id
        assert found["a b.jpg"].camera_id != found["c.jpg"].camera_id
        keypoints = database.read_keypoints(found["a b.jpg"].image_id)
        np.testing.assert_allclose(keypoints[:, :2], images["a b.jpg"][0].xy + 0.5, atol=1e-5)
        matches = database.read_matches(found["c.jpg"].image_id, found["a b.jpg"].image_id)
        np.testing.assert_array_equal(matches, rows)
