from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import ImageError
from deepdetect_lab.datasets.planar import (
    OXFORD_KINDS,
    load_hpatches,
    load_low_visibility,
    load_oxford,
)


def write_scene(folder: Path, images: list[str], homographies: list[str], shift: int = 0) -> None:
    """Write a scene whose homographies move by `shift` in x and the number of the image in y."""
    folder.mkdir()
    for name in images:
        (folder / name).touch()
    for number, name in enumerate(homographies, start=2):
        (folder / name).write_text(f"1 0 {shift}\n0 1 {number}\n0 0 1\n")


@pytest.fixture
def oxford(tmp_path: Path) -> Path:
    images = [f"img{number}.ppm" for number in range(1, 7)]
    for index, scene in enumerate(OXFORD_KINDS):
        write_scene(tmp_path / scene, images, [f"H1to{k}p" for k in range(2, 7)], index)
    (tmp_path / "graf" / "H1to6p.refined").write_text("1 0 0.5 0 1 0.5 0 0 1")
    return tmp_path


@pytest.fixture
def hpatches(tmp_path: Path) -> Path:
    for scene in ("v_wall", "i_dc", "i_pool", "other"):
        images = [f"{k}.{'png' if scene == 'v_wall' else 'ppm'}" for k in range(1, 7)]
        write_scene(tmp_path / scene, images, [f"H_1_{k}" for k in range(2, 7)])
    (tmp_path / "README").touch()
    return tmp_path


def test_oxford_scenes_have_six_images_and_five_pairs(oxford: Path) -> None:
    scenes = load_oxford(oxford)
    assert [scene.name for scene in scenes] == list(OXFORD_KINDS)
    boat = scenes[2]
    assert [pair.name for pair in boat.pairs] == [f"boat 1-{number}" for number in range(2, 7)]
    assert {pair.kind for pair in boat.pairs} == {"zoom and rotation"}
    assert [image.name for image in boat.images] == [f"img{number}.ppm" for number in range(1, 7)]
    assert boat.pairs[3].second.name == "img5.ppm"
    np.testing.assert_array_equal(boat.pairs[3].homography, [[1, 0, 2], [0, 1, 5], [0, 0, 1]])


def test_refined_homographies_are_taken_where_there_are(oxford: Path) -> None:
    published = load_oxford(oxford)[3].pairs
    refined = load_oxford(oxford, "refined")[3].pairs
    assert refined[4].homography[0, 2] == 0.5
    for old, new in zip(published[:4], refined[:4], strict=True):
        np.testing.assert_array_equal(old.homography, new.homography)


def test_fewer_pairs_keep_their_numbers(oxford: Path) -> None:
    graf = load_oxford(oxford)[3]
    assert [pair.name for pair in graf.with_max_pairs(1).pairs] == ["graf 1-6"]
    pairs = graf.with_max_pairs(3).pairs
    assert [pair.name for pair in pairs] == ["graf 1-2", "graf 1-4", "graf 1-6"]
    assert [pair.homography[1, 2] for pair in pairs] == [2, 4, 6]


def test_hpatches_scenes_come_with_the_light_first(hpatches: Path) -> None:
    scenes = load_hpatches(hpatches)
    assert [scene.name for scene in scenes] == ["i_dc", "i_pool", "v_wall"]
    assert [scene.pairs[0].kind for scene in scenes] == [*["illumination"] * 2, "viewpoint"]
    pair = scenes[2].pairs[3]
    assert (pair.name, pair.first.name, pair.second.name) == ("v_wall 1-5", "1.png", "5.png")
    np.testing.assert_array_equal(pair.homography, [[1, 0, 0], [0, 1, 5], [0, 0, 1]])


def test_what_is_missing_or_wrong_is_named(hpatches: Path) -> None:
    for load in (load_hpatches, load_oxford):
        with pytest.raises(ImageError):
            load(hpatches / "i_dc")
    (hpatches / "i_dc" / "H_1_4").write_text("1 2 3")
    with pytest.raises(ImageError):
        load_hpatches(hpatches)
    (hpatches / "i_dc" / "3.ppm").unlink()
    with pytest.raises(ImageError, match="image 3"):
        load_hpatches(hpatches)


def test_there_are_two_scenes_of_low_visibility(tmp_path: Path) -> None:
    for scene, end in (("dusty", "png"), ("smoky", "bmp")):
        write_scene(tmp_path / scene, [f"img1.{end}", f"img2.{end}"], ["H1to2p"])
    dusty, smoky = load_low_visibility(tmp_path)
    assert [pair.name for pair in dusty.pairs] == ["dusty 1-2"]
    assert [image.name for image in smoky.images] == ["img1.bmp", "img2.bmp"]


def test_the_shared_copies_can_be_read(shared: Path) -> None:
    data = shared / "data"
    assert sum(len(s.images) for s in load_oxford(data / "oxford", "refined")) == 48
    kinds = {scene.pairs[0].kind for scene in load_hpatches(data / "hpatches")}
    assert kinds == {"illumination", "viewpoint"}
    for scene in load_low_visibility(data / "low-visibility"):
        np.testing.assert_array_equal(scene.pairs[0].homography, np.eye(3))
