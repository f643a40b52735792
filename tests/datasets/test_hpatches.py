from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import ImageError
from deepdetect.datasets.hpatches import (
    NOT_IN_D2NET_SUBSET,
    in_d2net_subset,
    is_illumination,
    load_hpatches,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for index, scene in enumerate(("v_wall", "i_dc", "i_pool", "other")):
        (tmp_path / scene).mkdir()
        for number in range(1, 7):
            ending = "png" if scene == "v_wall" else "ppm"
            (tmp_path / scene / f"{number}.{ending}").touch()
            text = f"1 0 {index}\n0 1 {number}\n0 0 1\n"
            if number > 1:
                (tmp_path / scene / f"H_1_{number}").write_text(text)
    (tmp_path / "README").touch()
    return tmp_path


def test_scenes_have_six_images_with_the_light_first(folder: Path) -> None:
    scenes = load_hpatches(folder)
    assert [scene.name for scene in scenes] == ["i_dc", "i_pool", "v_wall"]
    assert [is_illumination(scene) for scene in scenes] == [True, True, False]
    pairs = list(scenes[2].pairs())
    assert [pair.name for pair in pairs] == [f"v_wall 1-{number}" for number in range(2, 7)]
    assert pairs[3].first.name == "1.png"
    assert pairs[3].second.name == "5.png"
    np.testing.assert_array_equal(pairs[3].homography, [[1, 0, 0], [0, 1, 5], [0, 0, 1]])


def test_eight_large_scenes_are_not_the_usual_ones(folder: Path) -> None:
    assert len(NOT_IN_D2NET_SUBSET) == 8
    assert [scene.name for scene in load_hpatches(folder) if not in_d2net_subset(scene)] == ["i_dc"]


def test_what_is_missing_is_named(folder: Path, one_line) -> None:
    with pytest.raises(ImageError, match="no HPatches scenes") as caught:
        load_hpatches(folder / "i_dc")
    one_line(caught.value)
    (folder / "i_dc" / "H_1_4").write_text("1 2 3")
    with pytest.raises(ImageError, match="nine numbers"):
        load_hpatches(folder)
    (folder / "i_dc" / "3.ppm").unlink()
    with pytest.raises(ImageError, match="no image 3") as caught:
        load_hpatches(folder)
    one_line(caught.value)


def test_the_shared_copy_can_be_read(shared: Path) -> None:
    scenes = load_hpatches(shared / "data" / "hpatches")
    assert {is_illumination(scene) for scene in scenes} == {True, False}
