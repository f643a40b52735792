from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pycolmap", reason="needs pycolmap")
pytest.importorskip("h5py", reason="needs h5py")
pytest.importorskip("matplotlib", reason="needs matplotlib")

from tests.cli.conftest import one_sentence

SCRIPT = Path(__file__).parents[2] / "examples/visual_odometry.py"


@pytest.mark.slow
def test_the_errors_are_below_those_that_the_page_promises(shared: Path, tmp_path: Path) -> None:
    words = ["--methods", "DeepDetect", "SIFT", "-o", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(shared / "data/kitti-clip"), *words],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    errors = json.loads((tmp_path / "errors.json").read_text())
    for name in ("DeepDetect", "SIFT"):
        found = errors[name]
        assert found["frames"] == 51
        assert found["end_percent"] < 2
        assert found["segment_percent"] < 2
        assert found["end_deg_per_m"] < 0.02
        assert len((tmp_path / f"{name.lower()}.txt").read_text().splitlines()) == 51
    assert (tmp_path / "trajectory.jpg").stat().st_size > 10_000


def test_an_unknown_method_is_refused(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), str(tmp_path), "--methods", "Deepdetect"],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "invalid choice: 'Deepdetect'" in done.stderr


def example(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.fixture
def sequence(photo: np.ndarray, tmp_path: Path) -> Path:
    """Three frames of a camera, in KITTI's layout."""
    folder = tmp_path / "sequence"
    folder.mkdir()
    for k in range(3):
        Image.fromarray(photo[:100, k : 160 + k]).save(folder / f"{k:06d}.png")
    (folder / "calib.txt").write_text("P0: 150 0 80 0 0 150 50 0 0 0 1 0\n")
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 3)
    return folder


@pytest.mark.parametrize(
    ("missing", "words", "message"),
    [
        ("*", [], "there is no image in"),
        ("*.txt", [], "there is no file {folder}/calib.txt"),
        ("poses.txt", [], "there is no file {folder}/poses.txt"),
        ("", ["--first", "2"], "there are not two frames from number 2 on"),
        ("", ["--first", "-1"], "there are not two frames from number -1 on"),
        ("", ["--max-keypoints", "0"], "max_keypoints"),
        ("", ["-o", "{folder}/calib.txt"], "cannot write {folder}/calib.txt"),
    ],
)
def test_a_mistake_is_one_sentence(
    missing: str, words: list[str], message: str, sequence: Path, tmp_path: Path
) -> None:
    for path in sequence.glob(missing) if missing else ():
        path.unlink()
    words = [word.format(folder=sequence) for word in words]
    done = example(sequence, "-o", tmp_path / "out", *words)
    assert done.returncode == 2, done.stderr
    assert message.format(folder=sequence) in done.stderr
    assert one_sentence(done.stderr)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("calib.txt", "hello", "must be twelve numbers"),
        ("calib.txt", "P0: 0 0 0 0 0 0 0 0 0 0 0 0", "focal"),
        ("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n", "1 lines, too few for frame 2"),
        ("poses.txt", "hello", "poses.txt"),
        ("000000.png", "hello", "000000.png is not an image"),
    ],
)
def test_a_damaged_file_is_named_in_one_sentence(
    name: str, text: str, message: str, sequence: Path, tmp_path: Path
) -> None:
    (sequence / name).write_text(text)
    done = example(sequence, "-o", tmp_path / "out")
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert one_sentence(done.stderr)


def test_frames_without_anything_give_no_path(sequence: Path, tmp_path: Path) -> None:
    for path in sequence.glob("*.png"):
        Image.new("RGB", (160, 100)).save(path)
    done = example(sequence, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("no path was found") == 6
