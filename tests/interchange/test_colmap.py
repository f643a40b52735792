from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pycolmap", reason="needs pycolmap")

from deepdetect import Camera, Keypoints, OptionError
from deepdetect.interchange import Collection
from deepdetect.interchange.colmap import write_colmap, write_colmap_text
from deepdetect.sfm.colmap import CameraIntrinsics, import_pycolmap

INTRINSICS = CameraIntrinsics.of_camera(Camera((120, 110), 100.0))


def test_colmap_reads_what_is_written(small_collection: Collection, tmp_path: Path) -> None:
    pycolmap = import_pycolmap()
    intrinsics = dict.fromkeys(small_collection.keypoints, INTRINSICS)
    (path,) = write_colmap(small_collection, tmp_path / "d.db", intrinsics=intrinsics, verify=False)
    with pycolmap.Database.open(path) as database:
        assert database.num_cameras() == 1
        ids = {image.name: image.image_id for image in database.read_all_images()}
        assert set(ids) == set(small_collection.keypoints)
        for name, points in small_collection.keypoints.items():
            rows = database.read_keypoints(ids[name])
            np.testing.assert_allclose(rows[:, :2], points.xy + 0.5, atol=1e-5)
            # COLMAP itself turns its affine shape into scale and orientation.
            for row, size, angle in zip(
                pycolmap.keypoints_from_matrix(rows), points.sizes, points.angles, strict=True
            ):
                assert row.compute_scale() == pytest.approx(size / 2, rel=1e-4)
                turned = np.degrees(row.compute_orientation()) - angle
                assert (turned + 180) % 360 - 180 == pytest.approx(0, abs=1e-2)
            found = database.read_descriptors(ids[name])
            np.testing.assert_array_equal(found.data, points.descriptors)
            assert found.type == pycolmap.FeatureExtractorType.SIFT
        for (name0, name1), matches in small_collection.matches.items():
            rows = database.read_matches(ids[name0], ids[name1])
            np.testing.assert_array_equal(rows, matches.rows)


def test_the_centre_of_a_pixel_is_where_colmap_finds_it(tmp_path: Path) -> None:
    """Known answer: COLMAP's own SIFT finds a blob half a pixel from where we say it is."""
    pycolmap = import_pycolmap()
    y, x = np.mgrid[:64, :64]
    blob = 255 * np.exp(-((x - 30) ** 2 + (y - 21) ** 2) / (2 * 4.0**2))
    gray = np.rint(blob).astype(np.uint8)
    Image.fromarray(gray).save(tmp_path / "blob.png")
    import cv2

    ours = max(cv2.SIFT_create(enable_precise_upscale=True).detect(gray), key=lambda k: k.response)
    np.testing.assert_allclose(ours.pt, (30, 21), atol=0.1)
    pycolmap.extract_features(tmp_path / "theirs.db", tmp_path, image_names=["blob.png"])
    points = Keypoints([ours.pt], [1], (64, 64))
    write_colmap(
        Collection({"blob.png": points}),
        tmp_path / "ours.db",
        intrinsics={"blob.png": CameraIntrinsics.initial((64, 64))},
    )
    places = []
    for name in ("theirs.db", "ours.db"):
        with pycolmap.Database.open(tmp_path / name) as database:
            rows = database.read_keypoints(database.read_all_images()[0].image_id)
            places.append(rows[np.linalg.norm(rows[:, :2] - (30, 21), axis=1).argmin(), :2])
    np.testing.assert_allclose(*places, atol=0.25)


def test_without_sizes_and_descriptors(tmp_path: Path) -> None:
    pycolmap = import_pycolmap()
    points = Keypoints([[3, 4]], [1], (120, 110))
    (path,) = write_colmap(
        Collection({"a": points}), tmp_path / "d.db", intrinsics={"a": INTRINSICS}
    )
    with pycolmap.Database.open(path) as database:
        np.testing.assert_allclose(database.read_keypoints(1)[:, :2], [[3.5, 4.5]])
        assert not len(database.read_descriptors(1).data)
    with pytest.raises(OptionError):
        write_colmap_text(Collection({"a": points}), tmp_path / "text")
    with pytest.raises(OptionError):
        write_colmap(Collection({"a": points}), tmp_path / "e.db", intrinsics={})
    with pytest.raises(OptionError):
        write_colmap(Collection({"a": points}), tmp_path / "e.txt", intrinsics={"a": INTRINSICS})


def test_text_files_hold_what_colmap_documents(
    small_collection: Collection, tmp_path: Path
) -> None:
    """https://colmap.github.io/tutorial.html: X, Y, SCALE, ORIENTATION, D_1, ..., D_128."""
    files = write_colmap_text(small_collection, tmp_path)
    assert len(files) == 4
    header, *rows = (tmp_path / "sub/b.jpg.txt").read_text().splitlines()
    points = small_collection.keypoints["sub/b.jpg"]
    assert header == "6 128"
    table = np.array([row.split() for row in rows], float)
    np.testing.assert_allclose(table[:, :2], points.xy + 0.5, atol=1e-3)
    np.testing.assert_allclose(table[:, 2], points.sizes / 2, atol=1e-3)
    np.testing.assert_allclose(table[:, 3], np.radians(points.angles), atol=1e-3)
    np.testing.assert_array_equal(table[:, 4:], points.descriptors)
    text = (tmp_path / "matches.txt").read_text()
    assert text == "a.jpg sub/b.jpg\n0 3\n5 1\n\nc.jpg a.jpg\n2 2\n\n"


@pytest.mark.slow
def test_the_program_colmap_maps_the_text_files(
    fountain, fountain_collection, tmp_path: Path, monkeypatch
) -> None:
    program = shutil.which("colmap")
    if program is None:
        pytest.skip("needs the program colmap (apt-get install colmap)")
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    write_colmap_text(fountain_collection, tmp_path / "text")
    (tmp_path / "sparse").mkdir()
    for words in (
        f"feature_importer --image_path {fountain} --import_path {tmp_path}/text",
        f"matches_importer --match_type raw --match_list_path {tmp_path}/text/matches.txt",
        f"mapper --image_path {fountain} --output_path {tmp_path}/sparse",
    ):
        command, *others = words.split()
        line = [program, command, "--database_path", str(tmp_path / "d.db"), *others]
        done = subprocess.run(line, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
    model = import_pycolmap().Reconstruction(tmp_path / "sparse/0")
    assert model.num_reg_images() == 4
    assert model.num_points3D() > 300
