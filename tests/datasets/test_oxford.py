from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import ImageError
from deepdetect.datasets.oxford import SCENES, load_oxford


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The public layout, with homographies that differ."""
    for index, scene in enumerate(SCENES):
        (tmp_path / scene).mkdir()
        for number in range(1, 7):
            (tmp_path / scene / f"img{number}.ppm").touch()
        for number in range(2, 7):
            text = f"1 0 {index}\n0 1 {number}\n0 0 1\n"
            (tmp_path / scene / f"H1to{number}p").write_text(text)
    (tmp_path / "graf" / "H1to6p.refined").write_text("1 0 0.5 0 1 0.5 0 0 1")
    return tmp_path


def test_scenes_have_six_images_and_five_pairs(folder: Path) -> None:
    scenes = load_oxford(folder)
    assert tuple(scene.name for scene in scenes) == SCENES
    pairs = list(scenes[SCENES.index("boat")].pairs())
    assert [pair.name for pair in pairs] == [f"boat 1-{number}" for number in range(2, 7)]
    assert {pair.kind for pair in pairs} == {"zoom and rotation"}
    assert pairs[3].second.name == "img5.ppm"
    np.testing.assert_array_equal(pairs[3].homography, [[1, 0, 2], [0, 1, 5], [0, 0, 1]])


def test_refined_homographies_are_taken_where_there_are(folder: Path) -> None:
    published = load_oxford(folder)[SCENES.index("graf")].homographies
    refined = load_oxford(folder, "refined")[SCENES.index("graf")].homographies
    assert refined[4][0, 2] == 0.5
    np.testing.assert_array_equal(published[:4], refined[:4])


def test_what_is_missing_or_wrong_is_named(folder: Path) -> None:
    (folder / "wall" / "H1to3p").write_text("1 2 3")
    with pytest.raises(ImageError, match="nine numbers"):
        load_oxford(folder)
    (folder / "ubc" / "img4.ppm").unlink()
    with pytest.raises(ImageError, match="no image img4 in"):
        load_oxford(folder)


def test_the_shared_copy_is_complete(shared: Path) -> None:
    scenes = load_oxford(shared / "data" / "oxford", "refined")
    assert sum(len(scene.images) for scene in scenes) == 48


@pytest.mark.parametrize(("count", "numbers"), [(1, [6]), (3, [2, 4, 6])])
def test_fewer_pairs_keep_their_numbers(folder: Path, count: int, numbers: list[int]) -> None:
    pairs = list(load_oxford(folder)[3].with_max_pairs(count).pairs())
    assert [pair.name for pair in pairs] == [f"graf 1-{number}" for number in numbers]
    assert [pair.second.name for pair in pairs] == [f"img{number}.ppm" for number in numbers]
    assert [pair.homography[1, 2] for pair in pairs] == numbers
