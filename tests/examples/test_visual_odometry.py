from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")
pytest.importorskip("h5py", reason="needs h5py")
pytest.importorskip("matplotlib", reason="needs matplotlib")

from tests.cli.conftest import one_sentence

from deepdetect import Camera
from deepdetect.tracking import TrackedFrame

FOLDER = Path(__file__).parents[2] / "examples/visual_odometry"
CAMERA = Camera((640, 480), 500.0)


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.syspath_prepend(FOLDER)
    spec = importlib.util.spec_from_file_location("example", FOLDER / "__main__.py")
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    yield module
    sys.modules.pop("odometry", None)


def draw_drive(
    count: int = 25, noise_px: float = 0.0, moving: int = 0, standing: int = 0
) -> tuple[list[TrackedFrame], np.ndarray]:
    """Tracks of random points that a camera passes with a slow turn, and its (F, 3, 4) poses."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-15, -6, 4), (15, 3, 60), (1500, 3))
    centre, poses, frames = np.zeros(3), [], []
    for k in range(count):
        sin, cos = np.sin(np.radians(0.3 * k)), np.cos(np.radians(0.3 * k))
        turn = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
        poses.append(np.column_stack([turn, centre]))
        seen = points.copy()
        seen[:moving] += [0.5 * k, 0, 0.2 * k]  # on something that drives
        inside = (seen - centre) @ turn
        xy = CAMERA.project(inside) + rng.normal(0, noise_px, (len(seen), 2))
        visible = (inside[:, 2] > 1) & (xy >= 0).all(1) & (xy < CAMERA.size).all(1)
        tracks = np.flatnonzero(visible)
        ones = np.ones(len(tracks))
        frames.append(TrackedFrame(k, tracks, xy[visible].astype(np.float32), ones, ones))
        if k >= standing:
            centre = centre + turn @ [0.02, 0, 0.8]
    return frames, np.array(poses)


@pytest.mark.parametrize(
    ("how", "end_percent", "end_deg_per_m"),
    [
        ({}, 0.01, 1e-4),
        ({"noise_px": 0.3, "moving": 200}, 1.5, 0.01),
        ({"noise_px": 0.1, "count": 20, "standing": 5}, 1.5, 0.02),
    ],
)
def test_drawn_tracks_give_the_path(
    example: ModuleType, how: dict, end_percent: float, end_deg_per_m: float
) -> None:
    frames, truth = draw_drive(**how)
    found = example.VisualOdometry(CAMERA)
    for frame in frames:
        found.update(frame)
    assert found.lost == []
    ((numbers, poses),) = found.trajectories()
    np.testing.assert_array_equal(numbers, np.arange(len(frames)))
    errors = example.trajectory_errors(poses, truth)
    assert errors["end_percent"] < end_percent
    assert errors["end_deg_per_m"] < end_deg_per_m


def test_it_begins_again_where_it_was_lost(example: ModuleType) -> None:
    frames, truth = draw_drive()
    found = example.VisualOdometry(CAMERA)
    for frame in frames:
        if frame.number == 12:
            frame = TrackedFrame(12, np.empty(0, np.int64), np.empty((0, 2)), *np.empty((2, 0)))
        found.update(frame)
    assert found.lost == [12]
    paths = found.trajectories()
    assert [numbers.tolist() for numbers, _ in paths] == [[*range(12)], [*range(13, 25)]]
    for numbers, poses in paths:
        assert example.trajectory_errors(poses, truth[numbers])["end_percent"] < 0.01


def test_a_camera_that_stands_has_no_path(example: ModuleType) -> None:
    found = example.VisualOdometry(CAMERA)
    frames, _ = draw_drive(count=10, standing=99)
    assert not any(found.update(frame) for frame in frames)
    assert found.trajectories() == []


def test_errors_have_known_values(example: ModuleType) -> None:
    path = np.tile(np.eye(3, 4), (31, 1, 1))
    path[:, 2, 3] = 2 * np.arange(31)
    away = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    moved = away @ path
    moved[:, :, 3] = 0.5 * path[:, :, 3] @ away.T + 7
    same = example.trajectory_errors(moved, path)
    assert max(same[name] for name in same if name != "centres") < 1e-9
    np.testing.assert_allclose(same["centres"], path[:, :, 3], atol=1e-9)
    aside = path.copy()
    aside[-1, 0, 3] = 3.0
    assert example.trajectory_errors(aside, path)["end_percent"] == pytest.approx(5, rel=1e-3)
    backwards = path.copy()
    backwards[:, :, 3] *= -1
    assert example.trajectory_errors(backwards, path)["end_percent"] == pytest.approx(100)


def run_example(*words: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize(("clip", "frames", "end"), [("kitti-clip", 51, 2), ("kitti-clip2", 60, 4)])
def test_clips_are_whole(shared: Path, tmp_path: Path, clip: str, frames: int, end: float) -> None:
    words = ["--methods", "DeepDetect", "SIFT", "-o", tmp_path]
    done = run_example(shared / "data" / clip, *words)
    assert done.returncode == 0, done.stderr
    numbers = json.loads((tmp_path / "errors.json").read_text())
    roads = ("DeepDetect", "SIFT", "DeepDetect, matched", "SIFT, matched")
    assert list(numbers) == [f"{road}, {count}" for count in (250, 500, 1000) for road in roads]
    for name, method in numbers.items():
        assert method["lost"] == []
        (path,) = method["paths"]
        assert path["frames"] == frames
        assert path["end_percent"] < end
        assert path["segment_percent"] < 1.5 * end
        assert path["end_deg_per_m"] < 0.03
        poses = tmp_path / f"{name.lower()} 0-{frames - 1}.txt"
        assert len(poses.read_text().splitlines()) == frames
    for error in ("end_percent", "mean_percent", "segment_percent"):
        paths = [method["paths"][0][error] for method in numbers.values()]
        ours, sift, ours_matched, sift_matched = np.reshape(paths, (3, 4)).mean(axis=0)
        assert ours < 1.02 * sift
        assert ours_matched < 1.02 * sift_matched
    assert done.stdout.count(", mean") == 4
    assert (tmp_path / "trajectory.jpg").stat().st_size > 10_000


def test_mistakes_are_one_sentence(tmp_path: Path) -> None:
    missing = run_example(tmp_path)
    assert missing.returncode == 2
    assert one_sentence(missing.stderr)
