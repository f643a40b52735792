from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.datasets.low_visibility import load_low_visibility


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for scene, ending in (("dusty", "png"), ("smoky", "bmp")):
        (tmp_path / scene).mkdir()
        for number in (1, 2):
            (tmp_path / scene / f"img{number}.{ending}").touch()
        (tmp_path / scene / "H1to2p").write_text("1 0 2 0 1 3 0 0 1")
    return tmp_path


def test_there_are_two_scenes_of_one_pair(folder: Path) -> None:
    scenes = load_low_visibility(folder)
    assert [[pair.name for pair in scene.pairs()] for scene in scenes] == [
        ["dusty 1-2"],
        ["smoky 1-2"],
    ]
    (pair,) = scenes[1].pairs()
    assert (pair.first.name, pair.second.name) == ("img1.bmp", "img2.bmp")
    np.testing.assert_array_equal(pair.homography, [[1, 0, 2], [0, 1, 3], [0, 0, 1]])


def test_the_shared_copy_does_not_move(shared: Path) -> None:
    for scene in load_low_visibility(shared / "data" / "low-visibility"):
        np.testing.assert_array_equal(scene.homographies[0], np.eye(3))
