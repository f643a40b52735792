"""Which images a run takes, which pairs it matches, and how."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError, OptionError, PointDetector, reconstruct_many
from deepdetect.batch.hdf5 import SETTINGS, open_hdf5
from deepdetect.sfm import MultiViewOptions
from deepdetect.sfm.stages import Stages, check_images


def test_small_sets_are_matched_exhaustively_and_large_ones_by_likeness() -> None:
    choices = [MultiViewOptions().pair_choice(count) for count in (3, 50, 51)]
    assert choices == ["exhaustive", "exhaustive", "similar"]
    assert MultiViewOptions(pairs="similar:2").pair_choice(3) == "similar:2"


@pytest.mark.parametrize(
    "wrong",
    [
        {"pairs": "sequental:3"},
        {"pairs": "sequential:0"},
        {"pairs": "similar:0"},
        {"stride_px": 1.5},
        {"mapper": "globally"},
        {"min_motion": 2},
        {"formats": ("text", "mesh"), "dense": False},
    ],
)
def test_wrong_options_are_refused(wrong: dict) -> None:
    with pytest.raises(OptionError):
        MultiViewOptions(**wrong)


def test_two_files_of_one_name_keep_their_folders(
    tmp_path: Path, photo_path: Path, pycolmap
) -> None:
    paths = [tmp_path / name / photo_path.name for name in "ab"]
    for path in paths:
        path.parent.mkdir()
        shutil.copy(photo_path, path)
    assert check_images([*paths, paths[0]]) == {f"{p.parent.name}/{p.name}": p for p in paths}
    with pytest.raises(ImageError):
        reconstruct_many([photo_path, tmp_path / "missing.jpg"], tmp_path / "model")
    with pytest.raises(OptionError):
        reconstruct_many([photo_path, paths[1].rename(tmp_path / "other")], tmp_path / "model")


@pytest.mark.parametrize(
    ("descriptor", "filter_by"), [("rootsift", "neighbours"), ("cross-modal", "ratio")]
)
def test_matches_are_filtered_as_their_descriptors_allow(
    write_fountain, tmp_path: Path, pycolmap, descriptor: str, filter_by: str
) -> None:
    folder = write_fountain(tmp_path / "photos", ("0004", "0005", "0006"))
    detector = PointDetector(1000, descriptor=descriptor)
    how = {"options": MultiViewOptions(dense=False), "detector": detector, "workers": 1}
    found = reconstruct_many(folder, tmp_path / "model", **how)
    with open_hdf5(tmp_path / "model" / "work" / "matches.h5") as file:
        assert json.loads(file.attrs[SETTINGS])["filter_by"] == filter_by
    assert len(found.views) == 3
    assert len(found.sparse) > 200
    assert np.median(found.sparse_errors) < 0.5


@pytest.fixture
def nested(tmp_path: Path, photo_path: Path) -> Path:
    """A folder of images in folders, with pictures of an earlier run's model among them."""
    folder = tmp_path / "photos"
    for name in ("3.png", "a/1.png", "b/2.png", "model/splat/images/3.png", "model/height.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(photo_path, folder / name)
    return folder


def test_results_among_the_images_are_no_images(nested: Path) -> None:
    for _ in range(2):
        made = Stages(nested / "model", MultiViewOptions(), 1, True).folder_of(nested)
        files = {path.resolve() for path in check_images(made).values()}
        assert files == {nested / name for name in ("3.png", "a/1.png", "b/2.png")}
    outside = Stages(nested.parent / "model", MultiViewOptions(), 1, True)
    assert len(check_images(outside.folder_of(nested))) == 5


def test_images_keep_their_names_where_results_are_among_them(nested: Path) -> None:
    made = Stages(nested / "model", MultiViewOptions(), 1, True).folder_of(nested)
    assert {*check_images(made)} == {"3.png", "a/1.png", "b/2.png"}


def test_a_caption_over_all_images_holds_no_keypoint(tmp_path: Path, pycolmap) -> None:
    photograph = pytest.importorskip("skimage.data").astronaut()
    for k in range(4):
        image = photograph[10 * k : 10 * k + 240, 30 * k : 30 * k + 320].copy()
        image[180:230, 20:200] = photograph[300:350, 200:380]
        (tmp_path / "images").mkdir(exist_ok=True)
        Image.fromarray(image).save(tmp_path / "images" / f"{k}.png")
    stages = Stages(tmp_path / "model", MultiViewOptions(), 1, True)
    for _ in range(2):  # the second time from its file
        with pytest.warns(UserWarning, match="still"):
            stages.extract(tmp_path / "images", PointDetector(500))
    with open_hdf5(stages.features) as file:
        for k in range(4):
            x, y = file[f"{k}.png"]["keypoints"][()].T
            assert len(x) > 100
            assert not ((x > 22) & (x < 198) & (y > 182) & (y < 228)).any()


def test_an_overlay_of_one_camera_among_several_is_found(facade, tmp_path: Path) -> None:
    paths, pixels = [], np.random.default_rng(0).integers(0, 256, (12, 24, 3), np.uint8)
    for size, marked in ((320, False), (400, True)):
        scene = facade(0.3)
        for number, view in enumerate((scene.left, scene.right, scene.left[:, ::-1])):
            image = np.array(view)[:, :size]
            if marked:
                image[10:58, 20:116] = pixels.repeat(4, 0).repeat(4, 1)
            paths.append(tmp_path / f"{size}-{number}.png")
            Image.fromarray(image).save(paths[-1])
    stages = Stages(tmp_path / "model", MultiViewOptions(), 1, quiet=True)
    with pytest.warns(UserWarning, match="still"):
        (overlay,) = stages.find_overlays([*reversed(paths)])
    assert overlay.shape == (300, 400)
    assert overlay[14:54, 24:112].mean() > 0.9
    assert stages.left_out == overlay.mean() < 0.2
