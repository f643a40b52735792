from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.cli.conftest import one_sentence

from deepdetect.tracking import FrameSource, load_tracks
from deepdetect.tracking.video import write_video


@pytest.fixture
def frames(tmp_path: Path) -> Path:
    """Four frames of a camera that moves over a photograph."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    photograph, folder = data.astronaut(), tmp_path / "frames"
    folder.mkdir()
    for k in range(4):
        Image.fromarray(photograph[40:200, 40 + 3 * k : 240 + 3 * k]).save(folder / f"{k}.png")
    return folder


def test_a_folder(run, frames: Path, tmp_path: Path) -> None:
    result = run("track", frames, "-o", "out.mp4", "--max-keypoints", 80, "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert summary["frames"] == 4
    assert summary["files"] == ["out.mp4", "out.csv"]
    table = load_tracks(tmp_path / "out.csv")
    assert [frame.number for frame in table] == [0, 1, 2, 3]
    assert max(len(frame) for frame in table) <= 80
    with FrameSource(tmp_path / "out.mp4") as video:
        assert len(list(video)) == 4
    # The tracks of a compressed video, of every second frame, as a table alone. In the video above,
    # the caption stands still.
    with write_video(tmp_path / "plain.mp4", 10) as write:
        for path in sorted(frames.iterdir()):
            write(np.asarray(Image.open(path)))
    result = run("track", "plain.mp4", "-o", "again.csv", "--every", 2)
    assert result.exit_code == 0, result.output
    assert "tracks per frame" in result.stdout
    assert [frame.number for frame in load_tracks(tmp_path / "again.csv")] == [0, 2]
    assert not (tmp_path / "again.mp4").exists()


def test_bad_frames_are_listed_at_the_end(run, frames: Path, tmp_path: Path) -> None:
    (frames / "1.png").write_bytes(b"no image")
    result = run("track", frames, "-o", "out.mp4", "--max-keypoints", 80, "--json")
    assert result.exit_code == 1, result.output
    assert "1.png" in result.stderr
    assert len(json.loads(result.stdout)["failures"]) == 1
    with FrameSource(tmp_path / "out.mp4") as video:
        assert len(list(video)) == 3


def test_a_video_that_is_cut_off_is_said_to_be(run, frames: Path, tmp_path: Path) -> None:
    with write_video(tmp_path / "whole.avi", 10) as write:
        for path in sorted(frames.iterdir()) * 3:
            write(np.asarray(Image.open(path)))
    content = (tmp_path / "whole.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(content[: len(content) * 2 // 3])
    texts = [
        run("track", name, "-o", f"{name}.csv", "--max-keypoints", 80).stderr
        for name in ("whole.avi", "cut.avi")
    ]
    assert "12 frames" not in texts[0]
    assert "12 frames" in texts[1]


def test_nothing_is_replaced_silently(run, frames: Path, tmp_path: Path) -> None:
    (tmp_path / "out.csv").write_text("mine")
    assert run("track", frames, "-o", "out.mp4").exit_code == 2
    assert (tmp_path / "out.csv").read_text() == "mine"
    words = ("track", frames, "-o", "out.mp4", "--max-frames", 2)
    assert run(*words, "--overwrite").exit_code == 0
    assert run(*words).exit_code == 0  # our own, of the same frames
    assert run("track", "out.mp4", "-o", "out.mp4").exit_code == 2


def test_recordings_of_a_camera_are_kept(run, tmp_path: Path, monkeypatch) -> None:
    import cv2
    from tests.tracking.test_video import Camera

    opened = cv2.VideoCapture
    monkeypatch.setattr(
        cv2, "VideoCapture", lambda name, *more: Camera(0) if name == 0 else opened(name, *more)
    )
    assert run("track", 0, "-o", "out.mp4").exit_code == 0
    assert (tmp_path / "out.mp4").stat().st_size
    assert run("track", 0, "-o", "out.mp4").exit_code == 2
    assert run("track", 0, "-o", "out.mp4", "--overwrite").exit_code == 0


@pytest.mark.parametrize("words", ["none.mp4", "text.mp4", "{} -o a.gif", "{} --every 0"])
def test_a_mistake_is_one_sentence_and_leaves_nothing(
    run, words: str, frames: Path, tmp_path: Path
) -> None:
    (tmp_path / "text.mp4").write_text("I am no video")
    result = run("track", *words.format(frames).split())
    assert result.exit_code == 2
    assert one_sentence(result.stderr)
    assert {path.name for path in tmp_path.iterdir()} == {"frames", "text.mp4"}


def test_a_run_that_is_stopped_leaves_nothing(
    run, frames: Path, tmp_path: Path, monkeypatch
) -> None:
    from deepdetect.tracking import pipeline

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline.TrackDrawer, "draw", stop)
    assert run("track", frames, "-o", "new/out.mp4").exit_code == 130
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
