"""Small photographs of the fountain, whose cameras are known; and what goes wrong with folders."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from deepdetect import (
    Camera,
    DeepDetectError,
    ImageError,
    Keypoints,
    NoDepthError,
    OptionError,
    PointDetector,
    ReconstructionError,
    load_image,
    reconstruct_many,
)
from deepdetect._shared.records import key
from deepdetect.batch.hdf5 import open_hdf5
from deepdetect.geometry.camera import PosedView
from deepdetect.sfm import MultiViewOptions, MultiViewReconstruction, stages
from deepdetect.sfm.colmap import CameraIntrinsics, write_database
from deepdetect.sfm.mapping import read_sparse_model, verify_pairs
from deepdetect.sfm.stages import Stages
from deepdetect_lab.datasets.posed_images import load_posed_scenes
from deepdetect_lab.evaluation.metrics.pose import camera_errors, rotation_error

QUICK = {
    "workers": 1,
    "detector": PointDetector(1000),
    "options": MultiViewOptions(stride_px=4),
}
SPARSE = {**QUICK, "options": MultiViewOptions(dense=False)}

Views = dict[str, PosedView]


def true_views(shared: Path) -> dict[str, PosedView]:
    """Return where the photographs of the fountain were taken, in metres."""
    (scene,) = load_posed_scenes(shared / "data" / "fountain")
    any_camera = Camera((3, 2), 1.0)
    return {
        image.path.name: PosedView(image.path.name, any_camera, image.rotation, image.translation)
        for image in scene.images
    }


def relative_rotation_error(views: Views, truth: Views) -> float:
    """Return the mean error in degrees of rotations from the first view.

    Four cameras stand nearly on a line, so that their centres say little of how it is turned.
    """
    first, *others = views
    pairs = [[each[name].relative_to(each[first]) for each in (views, truth)] for name in others]
    return float(np.mean([rotation_error(own.rotation, true.rotation) for own, true in pairs]))


def pose_errors(views: Views, truth: Views) -> tuple[float, float]:
    """Return mean errors of centres in mm and of rotations in degrees, once aligned."""
    distances, angles, _ = camera_errors([*views.values()], [truth[name] for name in views])
    return 1000 * float(distances.mean()), float(angles.mean())


@pytest.fixture(scope="module")
def small(write_fountain, tmp_path_factory) -> tuple[Path, Path, MultiViewReconstruction]:
    """A folder of good and bad photographs, that of their model, and the model."""
    pytest.importorskip("h5py", reason="needs h5py")
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    root = tmp_path_factory.mktemp("sfm")
    folder = write_fountain(root / "photos", ("0004", "0005", "0006"), 288)
    Image.new("RGB", (288, 192)).save(folder / "black.png")
    (folder / "broken.jpg").write_bytes((folder / "0004.jpg").read_bytes()[:2000])
    (folder / "04.jpg").write_bytes(b"no image")  # what is wrong with it is not said of 0004.jpg
    Image.fromarray(data.astronaut()[:192, :288]).save(folder / "other.jpg")
    return folder, root / "model", reconstruct_many(folder, root / "model", **QUICK)


def test_good_photographs_are_registered_and_bad_ones_named(small, shared: Path) -> None:
    _, _, found = small
    assert set(found.views) == {"0004.jpg", "0005.jpg", "0006.jpg"}
    assert set(found.unregistered) == {"04.jpg", "black.png", "broken.jpg", "other.jpg"}
    assert "broken.jpg" in found.unregistered["broken.jpg"]
    # Of a path of 2.5 m; the focal length is estimated.
    assert pose_errors(found.views, true_views(shared))[0] < 25
    assert relative_rotation_error(found.views, true_views(shared)) < 0.5
    focal = found.views["0005.jpg"].camera.focal_px[0]
    assert focal == pytest.approx(1380.9 * 288 / 1536, rel=0.04)


def test_points_agree_with_the_photographs(small) -> None:
    folder, _, found = small
    assert len(found.sparse) > 400
    assert len(found.dense) > 1500
    assert np.median(found.sparse_errors) < 0.5
    assert np.median(found.dense_errors) < 0.3
    assert found.dense_views.min() == 2  # holes of a surface that three agree on
    assert (found.dense_views >= 3).mean() > 0.8
    # The world is the frame of the reference, and 1 the spacing of the cameras.
    reference = found.views[found.reference]
    np.testing.assert_allclose(reference.rotation, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(reference.centre, 0, atol=1e-9)
    distances = np.linalg.norm(found.centres[:, None] - found.centres, axis=2)
    np.fill_diagonal(distances, np.inf)
    assert np.median(distances.min(axis=1)) == pytest.approx(1)
    # Dense points lie where the sparse ones do, as seen from there.
    depths = [np.median(cloud.points[:, 2]) for cloud in (found.dense, found.sparse)]
    assert depths[0] == pytest.approx(depths[1], rel=0.2)
    # A point has the colour of the photograph at its place.
    xy, depth = reference.project(found.dense.points)
    rgb = load_image(folder / found.reference)
    inside = ((xy > 1) & (xy < np.array(reference.camera.size) - 2)).all(axis=1) & (depth > 0)
    column, row = np.rint(xy[inside]).astype(int).T
    difference = np.abs(rgb[row, column].astype(int) - found.dense.colors[inside]).mean(axis=1)
    assert np.median(difference) < 12


def test_all_files_are_there_and_readable(small, pycolmap) -> None:
    _, output, _ = small
    assert {path.name for path in output.iterdir()} == {
        *("model.ply", "model.glb", "model.html", "model.json", "transforms.json"),
        *("sparse", "database.db", "work"),
    }
    values = json.loads((output / "model.json").read_text())
    assert (values["images"], values["registered"]) == (7, 3)
    assert [*values["seconds"]] == ["features", "matching", "mapping", "dense points"]
    model = pycolmap.Reconstruction(output / "sparse" / "0")
    assert model.num_reg_images() == 3
    assert model.num_points3D() == values["sparse_points"]
    for image in model.images.values():
        if image.has_pose:
            camera = values["cameras"][image.name]
            np.testing.assert_allclose(image.projection_center(), camera["centre"], atol=1e-6)
            assert image.camera.principal_point_x - 0.5 == pytest.approx(camera["cx"], abs=1e-3)
    header = (output / "model.ply").read_bytes()[:600].decode("ascii", "replace")
    assert f"element vertex {values['dense_points']}" in header


def test_a_run_goes_on_where_it_was_killed(small, tmp_path: Path, monkeypatch) -> None:
    folder, before, made = small
    output = tmp_path / "model"
    shutil.copytree(before, output)
    for name in ("model.ply", "model.json"):
        (output / name).unlink()
    lost, damaged, *kept = sorted((output / "work" / "dense").iterdir())
    lost.unlink()
    damaged.write_bytes(damaged.read_bytes()[:1000])
    times = {
        path: path.stat().st_mtime_ns for path in [*kept, output / "work" / "sparse" / "images.bin"]
    }
    monkeypatch.setattr(stages, "map_images", None)  # it would fail
    found = reconstruct_many(folder, output, **QUICK)
    assert times == {path: path.stat().st_mtime_ns for path in times}
    assert lost.exists()
    assert (output / "model.ply").read_bytes() == (before / "model.ply").read_bytes()
    assert found.matched == made.matched
    next((output / "work").glob("mapping-*.json")).write_text("")
    with pytest.raises(TypeError):  # it is mapped again
        reconstruct_many(folder, output, **QUICK)
    with pytest.raises(OptionError, match="max_keypoints"):
        reconstruct_many(folder, output, workers=1, detector=PointDetector(700))


KILLED_IN_MAPPING = """
import os, signal, sys
from deepdetect import PointDetector, reconstruct_many
from deepdetect.sfm import MultiViewOptions, stages

real = stages.map_images
kill = lambda count: os.kill(os.getpid(), signal.SIGKILL)
stages.map_images = lambda *arguments: real(*arguments[:-1], kill)
options = MultiViewOptions(dense=False)
reconstruct_many(*sys.argv[1:], PointDetector(1000), workers=1, options=options)
"""


def test_images_are_added_to_a_run_that_was_killed(
    write_fountain, tmp_path: Path, pycolmap
) -> None:
    folder = write_fountain(tmp_path / "photos", ("0004", "0005", "0006"))
    code = [sys.executable, "-c", KILLED_IN_MAPPING, folder, tmp_path / "model"]
    assert subprocess.run(code).returncode == -signal.SIGKILL
    write_fountain(folder, ("0003", "0007", "0008"))
    assert len(reconstruct_many(folder, tmp_path / "model", **SPARSE).views) == 6
    assert not [*(tmp_path / "model").glob("database.db-*")]


def test_a_known_camera_stays_as_it_is(write_fountain, shared: Path, tmp_path: Path, pycolmap):
    folder = write_fountain(tmp_path / "photos")
    camera = Camera((384, 256), (1379.74 / 4, 1382.08 / 4), (189.65, 125.41))
    found = reconstruct_many(
        sorted(folder.iterdir()), tmp_path / "model", calibration=camera, **SPARSE
    )
    assert len(found.views) == 4
    assert found.views["0004.jpg"].camera == camera
    assert len(found.dense) == 0
    assert found.cloud is found.sparse
    assert pose_errors(found.views, true_views(shared))[0] < 25
    assert relative_rotation_error(found.views, true_views(shared)) < 0.4


def test_several_cameras_upright_and_on_their_side(
    write_fountain, shared: Path, tmp_path: Path, pycolmap
) -> None:
    """Two photographs were taken with the camera turned, two by a camera with fewer pixels."""
    names = ("0003", "0004", "0005", "0006", "0007", "0008")
    folder = write_fountain(tmp_path / "photos", names, 480)
    write_fountain(folder, ("0005", "0007"), 320)
    for name in ("0004", "0006"):
        with Image.open(folder / f"{name}.jpg") as image:
            image.transpose(Image.Transpose.ROTATE_90).save(folder / f"{name}.jpg", quality=95)
    found = reconstruct_many(folder, tmp_path / "model", **SPARSE)
    assert (len(found.views), found.unregistered) == (6, {})
    # The top of the turned ones is what was on the right: x was down, and y is left.
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    truth = true_views(shared)
    for name in ("0004.jpg", "0006.jpg"):
        truth[name] = replace(
            truth[name],
            rotation=turn @ truth[name].rotation,
            translation=turn @ truth[name].translation,
        )
    assert pose_errors(found.views, truth)[0] < 25
    assert relative_rotation_error(found.views, truth) < 0.5
    for name, width in (("0003", 480), ("0004", 480), ("0005", 320)):
        focal = found.views[f"{name}.jpg"].camera.focal_px[0]
        assert focal == pytest.approx(1380.9 * width / 1536, rel=0.04)


def test_dense_matches_give_more_and_longer_tracks(small, tmp_path: Path, shared: Path) -> None:
    folder, output, found = small
    shutil.copytree(output / "work", tmp_path / "work")
    options = MultiViewOptions(matches="dense", dense=False)
    many = reconstruct_many(folder, tmp_path, **{**QUICK, "options": options})
    assert len(many.sparse) > 2 * len(found.sparse)
    assert many.sparse_views.mean() > found.sparse_views.mean()
    assert np.median(many.sparse_errors) < 0.3
    truth = true_views(shared)
    errors = [relative_rotation_error(each.views, truth) for each in (many, found)]
    assert errors[0] < errors[1] + 0.2


@pytest.mark.slow
def test_images_of_16_bits_have_one_range_in_every_file(
    write_fountain, tmp_path: Path, pycolmap
) -> None:
    factors = {"0004": 4, "0005": 16, "0006": 16}
    folder = write_fountain(tmp_path / "photos", factors, 288)
    for name, factor in factors.items():
        bgr = cv2.imread(str(folder / f"{name}.jpg")).astype(np.uint16)
        cv2.imwrite(str(folder / f"{name}.png"), bgr * factor)
        (folder / f"{name}.jpg").unlink()
    options = MultiViewOptions(stride_px=4, formats=("splat",))
    reconstruct_many(folder, tmp_path / "model", **{**QUICK, "options": options})
    means = {
        path.stem: cv2.imread(str(path)).mean() for path in tmp_path.glob("model/splat/images/*")
    }
    assert means["0004"] < 0.4 * min(means["0005"], means["0006"])


@pytest.mark.parametrize(
    "wrong",
    [
        {"calibration": "none.json"},
        {"calibration": "damaged.json"},
        {"scale_by": (0.5, "0004.jpg", "none.jpg")},
        {"scale_by": (0.5, "0004.jpg", "none.jpg:3,4")},
        {"control_points": "gcp_list.txt"},
    ],
)
def test_what_is_named_wrongly_is_said_before_the_work(
    write_fountain, tmp_path: Path, monkeypatch, pycolmap, wrong: dict
) -> None:
    pytest.importorskip("pyproj", reason="needs pyproj")
    folder = write_fountain(tmp_path / "photos", ("0004", "0005", "0006"))
    monkeypatch.chdir(tmp_path)
    Path("damaged.json").write_text("{")
    rows = [f"{k} 2 3 4 5 00{name}.jpg {k}" for k in range(3) for name in ("14", "15")]
    Path("gcp_list.txt").write_text("\n".join(["EPSG:32633", *rows]))
    given = {k: v for k, v in wrong.items() if k == "calibration"}
    options = MultiViewOptions(**{k: v for k, v in wrong.items() if k != "calibration"})
    kept = Path("model", "work", "features.h5")
    kept.parent.mkdir(parents=True)
    kept.touch()
    for images in (folder, [*folder.iterdir()]):
        with pytest.raises(DeepDetectError):
            reconstruct_many(images, "model", options=options, overwrite=True, **given)
    assert kept.exists()


def test_photographs_of_another_size_do_not_stop_a_calibrated_run(
    write_fountain, tmp_path: Path, photo: np.ndarray, pycolmap
) -> None:
    folder = write_fountain(tmp_path / "photos", ("0004", "0005", "0006"))
    Image.fromarray(photo).save(folder / "other.png")
    calibration = {"focal_px": [344.935, 345.52], "cx": 189.65, "cy": 125.41, "width": 384}
    (tmp_path / "calib.json").write_text(json.dumps({**calibration, "height": 256}))
    arguments = {"calibration": tmp_path / "calib.json", **SPARSE}
    found = reconstruct_many(folder, tmp_path / "model", **arguments)
    assert len(found.views) == 3
    assert "other.png" in found.unregistered
    assert found.intrinsics["0004.jpg"].source == "given"
    (tmp_path / "calib.json").write_text(json.dumps({**calibration, "height": 999}))
    with pytest.raises(ReconstructionError, match="384x999"):
        reconstruct_many(folder, tmp_path / "model", **arguments)
    of_one = {"focal_px": 300, "cx": 127.5, "cy": 127.5, "width": 256, "height": 256}
    (tmp_path / "calib.json").write_text(json.dumps(of_one))
    with pytest.raises(ReconstructionError):
        reconstruct_many(folder, tmp_path / "model", **arguments)
    with pytest.raises(OptionError):
        reconstruct_many(folder, tmp_path / "model", focal_px=300, **arguments)
    with pytest.raises(ReconstructionError, match="-5"):
        reconstruct_many(folder, tmp_path / "another", focal_px=-5, **SPARSE)
    assert not (tmp_path / "another").exists()


def test_pairs_are_chosen(small) -> None:
    _, output, found = small
    names = ["0004.jpg", "0005.jpg", "0006.jpg", "other.jpg"]
    assert (found.pairs, found.pair_choice) == (6, "exhaustive")
    for options in (MultiViewOptions("similar:1"), MultiViewOptions("sequential:1")):
        pairs = Stages(output, options, 1, True).choose_pairs(names)
        assert 2 <= len(pairs) < 6
        assert ("0005.jpg", "0006.jpg") in pairs


def test_of_two_scenes_the_larger_is_the_model(write_fountain, tmp_path: Path, pycolmap) -> None:
    """The negatives of three photographs are another scene: their descriptors are others."""
    folder = write_fountain(tmp_path / "photos", width=256)
    for name in ("0003", "0004", "0005"):
        with Image.open(folder / f"{name}.jpg") as image:
            ImageOps.invert(image).save(folder / f"negative-{name}.jpg")
    found = reconstruct_many(
        folder, tmp_path / "model", **{**SPARSE, "detector": PointDetector(500)}
    )
    assert set(found.views) == {"0003.jpg", "0004.jpg", "0005.jpg", "0006.jpg"}
    negatives = tuple(f"negative-{name}.jpg" for name in ("0003", "0004", "0005"))
    assert found.components == (negatives,)
    assert {*negatives} <= {*found.unregistered}
    values = json.loads((tmp_path / "model/model.json").read_text())
    assert values["components"] == [list(negatives)]
    assert (values["pairs"], values["pair_choice"]) == (21, "exhaustive")


def test_too_few_photographs_are_one_sentence(tmp_path: Path, photo: np.ndarray, pycolmap) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    with pytest.raises(ImageError):
        reconstruct_many(folder, tmp_path / "model", **QUICK)
    Image.fromarray(photo).save(folder / "a.png")
    Image.new("RGB", (200, 200)).save(folder / "black.png")
    with pytest.raises(ReconstructionError, match=r"black\.png"):
        reconstruct_many(folder, tmp_path / "model", **QUICK)


def test_the_order_of_imports_does_not_matter(pycolmap) -> None:
    """In a fresh process pycolmap comes after OpenCV, whatever the user imports first."""
    code = (
        "import deepdetect; from deepdetect.sfm.colmap import import_pycolmap; "
        "p = import_pycolmap(); import cv2, numpy as np; "
        "cv2.SIFT_create().detect(np.zeros((64, 64), np.uint8)); print(p.__name__)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, "pycolmap"), done.stderr


def test_many_keypoints_of_different_things_do_not_agree(
    write_fountain, shared: Path, tmp_path: Path, pycolmap
) -> None:
    folder = write_fountain(tmp_path / "photos", ("0003", "0006"), 1024)
    for name in ("05.jpg", "11.jpg"):
        shutil.copy(shared / "data" / "lund" / name, folder)
    made = Stages(tmp_path / "model", MultiViewOptions(), 1, True)
    sizes, *_ = made.extract(folder, PointDetector(8192))
    matches = made.match(made.choose_pairs(list(sizes)))
    images = {}
    with open_hdf5(made.features) as file:
        for name, size in sizes.items():
            xy = file[name]["keypoints"][()]
            points = Keypoints(xy, np.ones(len(xy), np.float32), size)
            images[name] = points, CameraIntrinsics.initial(size)
    write_database(tmp_path / "database.db", images, matches)
    assert set(verify_pairs(tmp_path / "database.db")) == {
        ("0003.jpg", "0006.jpg"),
        ("05.jpg", "11.jpg"),
    }


@pytest.mark.slow
def test_the_fountain_is_as_good_as_with_sift(shared: Path, tmp_path: Path, pycolmap) -> None:
    """All of the bars but time, beside pycolmap's own SIFT on the same photographs."""
    folder, truth = shared / "data" / "fountain", true_views(shared)
    camera = Camera((1536, 1024), (1379.74, 1382.08), (760.095, 503.155))
    parameters = ",".join(map(str, (*camera.focal_px, 760.595, 503.655)))
    known = {"camera_model": "PINHOLE", "camera_params": parameters}
    names = sorted(path.name for path in folder.glob("*.jpg"))
    for given in (camera, None):
        database = tmp_path / f"{given is None}.db"
        (tmp_path / f"{given is None}").mkdir()
        pycolmap.extract_features(
            database,
            folder,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=pycolmap.ImageReaderOptions(**(known if given else {})),
        )
        pycolmap.match_exhaustive(database)
        how = pycolmap.IncrementalPipelineOptions()
        if given:
            how.ba_refine_focal_length = how.ba_refine_extra_params = False
        models = pycolmap.incremental_mapping(database, folder, tmp_path / f"{given is None}", how)
        sift = read_sparse_model(max(models.values(), key=lambda model: model.num_reg_images()))
        theirs = pose_errors({view.name: view for view in sift.views.values()}, truth)
        found = reconstruct_many(
            folder,
            tmp_path / "model" / f"{given is None}",
            calibration=given,
            options=MultiViewOptions(dense=given is not None),
        )
        ours = pose_errors(found.views, truth)
        assert len(found.views) == 11
        assert ours[0] <= theirs[0] * (1 if given else 0.5)
        if not given:
            assert ours[1] <= theirs[1] * 0.5
        else:
            assert len(found.dense) >= 10 * len(sift.points)
            assert np.median(found.dense_errors) < 0.5


def test_frames_that_show_the_same_are_left_out(write_fountain, pycolmap, tmp_path: Path) -> None:
    names = ("0004", "0005", "0006")
    folder = write_fountain(tmp_path / "frames", names, 288)
    for name in names:
        with Image.open(folder / f"{name}.jpg") as image:
            moved = image.transform(image.size, Image.Transform.AFFINE, (1, 0, 3, 0, 1, 2))
            moved.save(folder / f"{name}b.jpg", quality=95)
    options = MultiViewOptions(dense=False, min_motion=0.018)
    found = reconstruct_many(folder, tmp_path / "model", **{**SPARSE, "options": options})
    assert [*found.views] == [f"{name}.jpg" for name in names]
    assert {*found.unregistered} == {f"{name}b.jpg" for name in names}
    assert found.pairs == 3
    other = {**SPARSE, "options": replace(options, mapper="global")}
    again = reconstruct_many(folder, tmp_path / "model", **other)  # maps anew
    assert [*again.views] == [*found.views]
    assert 0 < relative_rotation_error(again.views, found.views) < 0.5
    still = write_fountain(tmp_path / "still", names[:1], 288)
    for copy in "bcd":
        shutil.copy(still / "0004.jpg", still / f"{copy}.jpg")
    with pytest.raises(NoDepthError):
        reconstruct_many(still, tmp_path / "none", **{**SPARSE, "options": options})


@pytest.mark.skipif(sys.platform != "linux", reason="names of files are text elsewhere")
def test_a_name_that_is_no_text_is_a_named_failure(
    tmp_path: Path, photo_path: Path, pycolmap
) -> None:
    folder = tmp_path / "photos"
    folder.mkdir()
    odd = os.fsdecode(b"\xff.png")
    for name in ("good.png", odd):
        shutil.copy(photo_path, folder / name)
    made = Stages(tmp_path / "model", MultiViewOptions(), 1, True)
    sizes, keypoints, failures = made.extract(folder, PointDetector(50))
    assert (sizes, keypoints) == ({"good.png": (256, 256)}, {"good.png": 50})
    assert [*failures] == [odd]
    assert odd in failures[odd]


class Mapped(Exception):
    """It would be mapped now."""


@pytest.mark.parametrize(("matches", "differ"), [("dense", True), ("sparse", False)])
def test_dense_matches_of_another_stride_are_mapped_anew(
    matches: str, differ: bool, small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, output, found = small
    (tmp_path / "work").mkdir()
    shutil.copy(output / "work" / "features.h5", tmp_path / "work")
    keys: list[str] = []

    def noted(*parts: object) -> str:
        keys.append(key(*parts))
        raise Mapped

    monkeypatch.setattr(stages, "key", noted)
    for stride in (2, 4, 2):
        options = MultiViewOptions(matches=matches, stride_px=stride)
        with pytest.raises(Mapped):
            Stages(tmp_path, options, 1, True).map(tmp_path, found.intrinsics, {}, False)
    assert keys[0] == keys[2]
    assert (keys[0] != keys[1]) == differ


@pytest.mark.parametrize(("name", "kept"), [("notes.txt", True), ("features.h5", False)])
def test_only_the_work_of_a_run_is_overwritten(
    name: str, kept: bool, tmp_path: Path, pycolmap
) -> None:
    (tmp_path / "photos").mkdir()
    work = tmp_path / "model" / "work"
    work.mkdir(parents=True)
    (work / name).write_text("anything")
    with pytest.raises(ImageError):  # there are no images
        reconstruct_many(tmp_path / "photos", work.parent, workers=1, overwrite=True)
    assert (work / name).exists() == kept
