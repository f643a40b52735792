from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect.tracking import Trajectory, load_poses, save_poses


def test_kitti_poses_are_read_and_written(shared: Path, tmp_path: Path) -> None:
    truth = load_poses(shared / "data/kitti-clip/poses.txt")
    assert len(truth) == 51
    assert truth.length == pytest.approx(59.9, abs=0.2)
    np.testing.assert_allclose(
        truth.rotations @ truth.rotations.transpose(0, 2, 1),
        np.eye(3)[None].repeat(51, 0),
        atol=1e-5,
    )
    save_poses(truth, tmp_path / "poses.txt")
    again = load_poses(tmp_path / "poses.txt")
    np.testing.assert_allclose(again.centres, truth.centres, rtol=1e-8)


def test_poses_of_some_frames() -> None:
    path = Trajectory(np.array([2, 4, 7]), np.stack([np.eye(3)] * 3), np.eye(3))
    assert path.at(np.array([4, 7])).centres.tolist() == [[0, 1, 0], [0, 0, 1]]
    with pytest.raises(OptionError, match="frame 5"):
        path.at(np.array([2, 5]))
    with pytest.raises(OptionError):
        Trajectory(np.arange(3), np.eye(3), np.eye(3))


@pytest.mark.parametrize("text", ["1 2 3\n", "a b\n"])
def test_another_file_is_one_sentence(text: str, tmp_path: Path, one_line) -> None:
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(DeepDetectError) as caught:
        load_poses(tmp_path / "p.txt")
    assert "holds no poses" in one_line(caught.value)
    with pytest.raises(DeepDetectError, match="no file"):
        load_poses(tmp_path / "q.txt")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1 0 0 0 0 0 0 1\n" * 3, "8 numbers, not 12"),  # TUM's format, of 2 x 12 numbers
        ("nan " * 12, "not finite"),
    ],
)
def test_what_is_no_kitti_file_is_refused(tmp_path: Path, one_line, text: str, words: str) -> None:
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(DeepDetectError, match=words) as caught:
        load_poses(tmp_path / "poses.txt")
    one_line(caught.value)


def test_a_path_without_poses_comes_back(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("")
    assert len(load_poses(tmp_path / "poses.txt")) == 0
