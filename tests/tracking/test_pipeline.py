from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from deepdetect import OptionError
from deepdetect.tracking import FrameSource, Tracker, TrackingOptions, load_tracks, track
from deepdetect.tracking.pipeline import track_frames

FEW = TrackingOptions(max_keypoints=100)


def test_video_and_table_of_a_folder(frame_folder, tmp_path: Path) -> None:
    report = track(frame_folder, tmp_path / "out" / "t.mp4", options=FEW)
    assert report.files == (tmp_path / "out" / "t.mp4", tmp_path / "out" / "t.csv")
    frames = load_tracks(tmp_path / "out" / "t.csv")
    assert report.frames == len(frames) == 6
    assert report.tracks == len({track for frame in frames for track in frame.tracks.tolist()})
    assert report.tracks_per_frame == pytest.approx(np.mean([len(frame) for frame in frames]))
    with FrameSource(tmp_path / "out" / "t.mp4") as drawn:
        shown = list(drawn)
    assert len(shown) == 6
    assert shown[0].rgb.shape == (240, 320, 3)
    assert sorted(os.listdir(tmp_path / "out")) == ["t.csv", "t.mp4"]


def test_points_are_followed_past_a_bad_frame(frame_folder, tmp_path: Path) -> None:
    (frame_folder / "002.png").write_bytes(b"no image")
    report = track(frame_folder, tmp_path / "t.csv", options=FEW)
    frames = load_tracks(tmp_path / "t.csv")
    assert [frame.number for frame in frames] == [0, 1, 3, 4, 5]
    assert (report.frames, report.expected, len(report.failures)) == (5, 6, 1)
    shared, rows0, rows1 = np.intersect1d(frames[1].tracks, frames[2].tracks, True, True)
    assert len(shared) > 0.6 * len(frames[1])
    moved = np.median(frames[2].xy[rows1] - frames[1].xy[rows0], axis=0)
    np.testing.assert_allclose(moved, [-6, -4], atol=0.1)  # of two frames


def test_a_table_alone(frame_folder, tmp_path: Path) -> None:
    report = track(frame_folder, tmp_path / "t.csv", options=FEW, max_frames=2, every=3)
    assert report.files == (tmp_path / "t.csv",)
    assert [frame.number for frame in load_tracks(tmp_path / "t.csv")] == [0, 3]


def test_positions_are_of_the_frame_not_of_the_small_one(frame_folder) -> None:
    """The centre of the first pixel is (0, 0) in both: (x + .5) / s - .5."""
    from deepdetect import Keypoints

    def corners(rgb: np.ndarray) -> Keypoints:
        height, width = rgb.shape[:2]
        return Keypoints([[0, 0], [width - 1, height - 1]], [1, 1], (width, height))

    with FrameSource(frame_folder, max_frames=1) as source:
        ((_, found),) = track_frames(source, Tracker(corners), max_side=160)
    np.testing.assert_allclose(found.xy, [[0.5, 0.5], [318.5, 238.5]])


class Camera:
    """What OpenCV gives for a camera; before its third frame, and further ones, signals come."""

    def __init__(self, moving_photo: Callable[[int], np.ndarray], signals: Sequence[int]) -> None:
        self.moving_photo, self.signals, self.frames = moving_photo, list(signals), 0

    def isOpened(self) -> bool:
        return True

    def get(self, _: int) -> float:
        return 0.0

    def read(self) -> tuple[bool, np.ndarray]:
        self.frames += 1
        if self.frames == 3:
            for number in self.signals:
                assert signal.getsignal(number) is not signal.SIG_DFL, "it would end the tests"
                signal.raise_signal(number)
        return True, self.moving_photo(self.frames % 6)[..., ::-1]

    def release(self) -> None:
        pass


@pytest.fixture
def camera(moving_photo, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Make a camera 0 to which these signals come."""
    import cv2

    real = cv2.VideoCapture

    def connect(*signals: int) -> None:
        monkeypatch.setattr(
            cv2,
            "VideoCapture",
            lambda name, *more: Camera(moving_photo, signals) if name == 0 else real(name, *more),
        )

    return connect


ENDING = [
    number
    for name in ("SIGINT", "SIGTERM", "SIGHUP")
    if (number := getattr(signal, name, None)) is not None
    and signal.getsignal(number) is not signal.SIG_IGN  # by nohup
]


@pytest.mark.parametrize("number", ENDING)
def test_a_signal_ends_a_camera_properly(number: int, camera, tmp_path: Path) -> None:
    """Before the third frame is there: its files are whole, and the usual handler is back."""
    before = signal.getsignal(number)
    camera(number)
    report = track(0, tmp_path / "t.mp4", options=FEW)
    assert report.frames == 3
    assert signal.getsignal(number) is before
    assert len(load_tracks(tmp_path / "t.csv")) == 3
    with FrameSource(tmp_path / "t.mp4") as written:
        assert len(list(written)) == 3


@pytest.mark.parametrize(
    ("numbers", "error"),
    [
        ((signal.SIGTERM, signal.SIGINT), KeyboardInterrupt),
        ((signal.SIGINT, signal.SIGTERM), SystemExit),
    ],
)
def test_a_second_signal_ends_all_at_once(numbers, error, camera, tmp_path: Path) -> None:
    before = [signal.getsignal(number) for number in numbers]
    camera(*numbers)
    with pytest.raises(error):
        track(0, tmp_path / "t.mp4", options=FEW)
    assert [signal.getsignal(number) for number in numbers] == before
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="signals of POSIX")
def test_signals_that_the_caller_handles_or_ignores_are_left_to_it(camera, tmp_path: Path) -> None:
    """As nohup ignores that of a closed terminal."""

    class Ended(Exception):
        pass

    def end(*_: object) -> None:
        raise Ended

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN), signal.signal(signal.SIGTERM, end)
    try:
        camera(signal.SIGHUP)
        assert track(0, tmp_path / "t.mp4", options=FEW, max_frames=4).frames == 4
        camera(signal.SIGTERM)
        with pytest.raises(Ended):
            track(0, tmp_path / "t.mp4", options=FEW)
        assert signal.getsignal(signal.SIGTERM) is end
    finally:
        signal.signal(signal.SIGHUP, before[0])
        signal.signal(signal.SIGTERM, before[1])


def test_an_interrupt_of_a_video_leaves_nothing(frame_folder, tmp_path: Path) -> None:
    class Interrupted:
        def detect(self, *arguments: object, **options: object):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        track(frame_folder, tmp_path / "t.mp4", detector=Interrupted(), options=FEW)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


@pytest.mark.parametrize(("name", "values"), [("t.gif", {}), ("t.mp4", {"tail": 0})])
def test_wrong_options(name: str, values, frame_folder, tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        track(frame_folder, tmp_path / name, options=FEW, **values)
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


def test_a_video_is_not_replaced_by_its_tracks(
    frame_folder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track(frame_folder, tmp_path / "v.mp4", options=FEW, max_frames=2)
    content = (tmp_path / "v.mp4").read_bytes()
    (tmp_path / "v.csv").unlink()
    (tmp_path / "link.mp4").symlink_to(tmp_path / "v.mp4")
    monkeypatch.chdir(tmp_path)
    for source, output in (
        (tmp_path / "v.mp4", tmp_path / "v.mp4"),
        ("v.mp4", str(tmp_path / "v.mp4")),
        ("link.mp4", "v.mp4"),
    ):
        with pytest.raises(OptionError):
            track(source, output, options=FEW)
    assert (tmp_path / "v.mp4").read_bytes() == content
    assert sorted(os.listdir(tmp_path)) == ["frames", "link.mp4", "v.mp4"]


def test_no_track_follows_a_caption(moving_photo, tmp_path: Path) -> None:
    folder = tmp_path / "frames"
    folder.mkdir()
    for k in range(8):
        frame = moving_photo(k, (8, 5))
        frame[10:60, 20:140] = moving_photo(0)[100:150, 60:180]
        Image.fromarray(frame).save(folder / f"{k:03d}.png")
    with pytest.warns(UserWarning, match="still"):
        report = track(folder, tmp_path / "t.csv", options=FEW)
    assert 0.05 < report.left_out < 0.3
    for frame in load_tracks(tmp_path / "t.csv"):
        x, y = frame.xy.T
        assert len(frame) > 20
        assert not ((x > 22) & (x < 138) & (y > 12) & (y < 58)).any()


def test_a_caption_of_a_camera_is_found_once_frames_were_seen(
    moving_photo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Camera:
        def __init__(self, _: int) -> None:
            self.frames = 0

        def isOpened(self) -> bool:
            return True

        def get(self, _: int) -> float:
            return 0.0

        def read(self):
            frame = moving_photo(self.frames, (8, 5))
            frame[10:60, 20:140] = moving_photo(0)[100:150, 60:180]
            self.frames += 1
            return self.frames <= 10, frame

        def release(self) -> None:
            pass

    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    monkeypatch.setattr("deepdetect.tracking.pipeline.MAX_STEP", 1)
    with pytest.warns(UserWarning, match="still"):
        report = track(0, tmp_path / "t.csv", options=FEW)
    assert 0.05 < report.left_out < 0.3
    x, y = load_tracks(tmp_path / "t.csv")[-1].xy.T
    assert not ((x > 22) & (x < 138) & (y > 12) & (y < 58)).any()
