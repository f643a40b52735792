from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest

from deepdetect import DeepDetectError, OptionError
from deepdetect.tracking import TrackedFrame
from deepdetect.tracking.video import (
    CODECS,
    TrackDrawer,
    track_color,
    write_video,
)


def test_there_is_no_file_unless_it_is_whole(moving_photo, tmp_path: Path) -> None:
    def stopped() -> None:
        with write_video(tmp_path / "v.mp4", 10) as write:
            write(moving_photo(0))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stopped()
    with pytest.raises(DeepDetectError, match="no frame"), write_video(tmp_path / "v.mp4", 10):
        pass
    with pytest.raises(OptionError, match="must end in"), write_video(tmp_path / "v.gif", 10):
        pass
    assert not list(tmp_path.iterdir())


def test_no_encoder_is_one_sentence(moving_photo, tmp_path: Path, monkeypatch, one_line) -> None:
    import cv2

    class Closed:
        def open(self, *arguments: object) -> None:
            pass

        def isOpened(self) -> bool:
            return False

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoWriter", Closed)
    with pytest.raises(DeepDetectError) as caught, write_video(tmp_path / "v.mp4", 10) as write:
        write(moving_photo(0))
    assert "no encoder (mp4v)" in one_line(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", sorted(CODECS))
def test_a_full_disk_is_one_sentence(suffix: str, tmp_path: Path, one_line) -> None:
    """The limit of a file's size stands for the disk, of which OpenCV says nothing."""
    resource = pytest.importorskip("resource", reason="needs limits of processes")
    noise = np.random.default_rng(0).integers(0, 256, (20, 120, 160, 3), dtype=np.uint8)

    def write_noise() -> None:
        with write_video(tmp_path / f"v{suffix}", 10) as write:
            for frame in noise:
                write(frame)

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    usual = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(DeepDetectError) as caught:
            write_noise()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, usual)
    message = one_line(caught.value)
    assert message.startswith(f"cannot write {tmp_path / 'v'}{suffix} (")
    assert "of 20 frames" in message
    assert not list(tmp_path.iterdir())


def test_frames_of_another_size_are_refused(moving_photo, tmp_path: Path) -> None:
    with write_video(tmp_path / "v.avi", 10) as write:
        write(moving_photo(0))
        with pytest.raises(DeepDetectError, match="pixels"):
            write(moving_photo(0)[:100])


def test_tracks_are_drawn_where_they_are() -> None:
    black = np.zeros((60, 80, 3), np.uint8)
    drawer = TrackDrawer(tail=3)
    drawn = black
    for k, x in enumerate((20.0, 30.0, 40.0)):
        frame = TrackedFrame(k, np.array([5]), np.array([[x, 30]]), np.ones(1), np.array([k]))
        drawn = drawer.draw(black, frame)
    color = np.array(track_color(5), float)
    for x in (20, 30, 40):  # lines are blended with what is below
        seen = drawn[30, x].astype(float)
        assert seen.max() > 120
        np.testing.assert_allclose(seen / seen.max(), color / color.max(), atol=0.05)
    assert not drawn[50:].any()
    assert not black.any()
    assert drawer.draw(black, frame, "12 frames/s").astype(int).sum() > drawn.astype(int).sum()
