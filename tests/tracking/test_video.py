from __future__ import annotations

import re
import signal
import zipfile
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image

from deepdetect import DeepDetectError, ImageError, OptionError
from deepdetect._shared.errors import BatchError, InvalidFileError, MissingFileError
from deepdetect.tracking import FrameSource
from deepdetect.tracking.video import CODECS, write_video


def test_a_folder_gives_its_images_by_name(frame_folder, moving_photo) -> None:
    with FrameSource(frame_folder, every=2) as source:
        assert (source.count, source.live, source.fps) == (3, False, 5.0)
        frames = list(source)
    assert [frame.number for frame in frames] == [0, 2, 4]
    np.testing.assert_array_equal(frames[1].rgb, moving_photo(2))


def test_a_video_gives_what_was_written(moving_photo, tmp_path: Path) -> None:
    with write_video(tmp_path / "v.mp4", 12.0) as write:
        for k in range(6):
            write(moving_photo(k))
    with FrameSource(tmp_path / "v.mp4") as source:
        assert source.count == 6
        assert source.fps == pytest.approx(12)
        frames = list(source)
    assert len(frames) == 6
    # Compressed, and red is not blue.
    for k, frame in enumerate(frames):
        assert np.abs(frame.rgb.astype(int) - moving_photo(k)).mean() < 6
    with FrameSource(tmp_path / "v.mp4", every=4, max_frames=5) as source:
        assert source.count == 2
        assert [frame.number for frame in source] == [0, 4]
    with FrameSource(tmp_path / "v.mp4", max_frames=2) as source:
        assert source.count == len(list(source)) == 2


def test_an_image_that_is_no_frame_is_left_out(frame_folder, moving_photo) -> None:
    (frame_folder / "002.png").write_bytes(b"no image")
    Image.fromarray(moving_photo(3)[:-9]).save(frame_folder / "003.png")
    with FrameSource(frame_folder, max_frames=3) as source:
        assert [frame.number for frame in source] == [0, 1, 4]
        bad, small = source.failures
    assert "002.png" in bad
    assert "003.png" in small
    for path in frame_folder.iterdir():
        path.write_bytes(b"no image")
    with FrameSource(frame_folder) as source, pytest.raises(BatchError):
        next(iter(source))


def test_the_pages_of_an_image_file_are_frames(moving_photo, tmp_path: Path) -> None:
    frames = [moving_photo(k) for k in range(4)]
    tifffile.imwrite(tmp_path / "stack.TIF", np.stack(frames), photometric="rgb")
    images = [Image.fromarray(frame) for frame in frames]
    images[0].save(tmp_path / "moving.png", save_all=True, append_images=images[1:])
    for name in ("stack.TIF", "moving.png"):
        with FrameSource(tmp_path / name, every=2) as source:
            assert source.count == 2
            for frame in source:
                np.testing.assert_array_equal(frame.rgb, frames[frame.number])
    for name, axes in (("channels.tif", "TCYX"), ("slices.ome.tif", "TZYX")):
        both = np.stack([np.stack([frame[..., k] for frame in frames]) for k in (0, 1)], axis=1)
        own = {"ome": True} if "ome" in name else {"imagej": True}
        tifffile.imwrite(tmp_path / name, both, metadata={"axes": axes}, **own)
        with pytest.raises(ImageError, match=r"\(T\)"):
            FrameSource(tmp_path / name)
    with tifffile.TiffWriter(tmp_path / "pyramid.tif") as writer:
        for step in (1, 2, 4):
            writer.write(frames[0][::step, ::step].copy(), photometric="rgb")
    with pytest.raises(ImageError, match="single"):
        FrameSource(tmp_path / "pyramid.tif")


def interlaced(mpeg2: bytes) -> bytes:
    """Set the flags of an MPEG-2 video (ISO/IEC 13818-2, 6.2) that say that it is interlaced."""
    changed = bytearray(mpeg2)
    for found in re.finditer(rb"\x00\x00\x01\xb5[\x10-\x1f\x80-\x8f]", mpeg2):
        start = found.start() + 4
        if changed[start] >> 4 == 1:
            changed[start + 1] &= 0xF7  # progressive_sequence
        else:
            changed[start + 3] &= 0xFE  # chroma_420_type
            changed[start + 4] &= 0x7F  # progressive_frame
    return bytes(changed)


@pytest.mark.parametrize("suffix", [".mpg", ".ts", ".mkv", ".avi"])
def test_interlaced_videos_give_their_frames_or_none(
    suffix: str, moving_photo, tmp_path: Path
) -> None:
    path, photo = tmp_path / f"plain{suffix}", moving_photo(0)
    shape, code = (photo.shape[1], photo.shape[0]), cv2.VideoWriter_fourcc(*"mpg2")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 25, shape)
    if not writer.isOpened():
        pytest.skip("the installed OpenCV does not write MPEG-2")
    for k in range(6):
        writer.write(moving_photo(k)[..., ::-1].copy())
    writer.release()
    (tmp_path / f"interlaced{suffix}").write_bytes(interlaced(path.read_bytes()))

    def errors(name: str) -> list[float]:
        with FrameSource(tmp_path / f"{name}{suffix}") as source:
            return [np.abs(f.rgb.astype(int) - moving_photo(f.number)).mean() for f in source]

    assert max(errors("plain")) < 12
    with suppress(InvalidFileError):  # OpenCV 4.14 and 5.0 decode nothing
        assert max(errors("interlaced")) < 12


def test_a_video_in_which_nothing_moves_is_read(moving_photo, tmp_path: Path) -> None:
    shape = moving_photo(0).shape[1::-1]
    path, code = tmp_path / "still.avi", cv2.VideoWriter_fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, code, 25, shape)
    for _ in range(6):
        writer.write(moving_photo(0)[..., ::-1].copy())
    writer.release()
    with FrameSource(path) as source:
        assert len(list(source)) == 6


def test_packets_that_change_nothing_may_differ(moving_photo, tmp_path: Path) -> None:
    shape = moving_photo(0).shape[1::-1]
    path, code = tmp_path / "still.mp4", cv2.VideoWriter_fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, 25, shape)
    for _ in range(8):
        writer.write(np.full((*shape[::-1], 3), 200, np.uint8))
    writer.release()
    with FrameSource(path) as source:
        assert len(list(source)) == 8


@pytest.mark.parametrize("still", [0, 6])
def test_a_video_that_is_interlaced_from_its_middle_gives_its_frames_or_an_error(
    still: int, moving_photo, tmp_path: Path
) -> None:
    shape, code = moving_photo(0).shape[1::-1], cv2.VideoWriter_fourcc(*"mpg2")
    numbers = [*[0] * still, *range(12)]
    for name in ("plain.mpg", "interlaced.mpg"):
        writer = cv2.VideoWriter(str(tmp_path / name), cv2.CAP_FFMPEG, code, 25, shape)
        if not writer.isOpened():
            pytest.skip("the installed OpenCV does not write MPEG-2")
        for k in numbers:
            writer.write(moving_photo(k)[..., ::-1].copy())
        writer.release()
    first, second = ((tmp_path / name).read_bytes() for name in ("plain.mpg", "interlaced.mpg"))
    path = tmp_path / "both.mpg"
    path.write_bytes(first + interlaced(second))
    with FrameSource(path) as source:
        try:
            frames = [frame.rgb for frame in source]
        except InvalidFileError:  # OpenCV 4.14 and 5.0
            return
    expected = [moving_photo(k) for k in numbers] * 2  # OpenCV 4.13
    for found, true in zip(frames, expected, strict=True):
        assert np.abs(found.astype(int) - true).mean() < 12


class Camera:
    """What OpenCV gives for a camera, of three frames."""

    opened = True
    released = 0

    def __init__(self, number: int) -> None:
        self.number, self.left = number, 3

    def isOpened(self) -> bool:
        return self.opened

    def get(self, _: int) -> float:
        return 0.0

    def grab(self) -> bool:
        self.left -= 1
        return self.left >= 0

    def read(self):
        blue = np.zeros((48, 64, 3), np.uint8)
        blue[..., 0] = 200
        return self.grab(), blue

    def release(self) -> None:
        Camera.released += 1


def test_a_camera_by_its_number(monkeypatch) -> None:
    monkeypatch.setattr(cv2, "VideoCapture", Camera)
    for given in (1, "1"):
        Camera.released = 0
        with FrameSource(given) as source:
            assert (source.camera, source.live, source.count) == (1, True, None)
            frames = list(source)
        assert len(frames) == 3
        assert frames[0].rgb[0, 0].tolist() == [0, 0, 200]
        assert Camera.released == 1
    monkeypatch.setattr(Camera, "opened", False)
    with pytest.raises(MissingFileError):
        FrameSource(1)


def test_a_folder_named_like_a_camera_is_a_folder(frame_folder, tmp_path, monkeypatch) -> None:
    frame_folder.rename(tmp_path / "7")
    monkeypatch.chdir(tmp_path)
    with FrameSource("7") as source:
        assert not source.live


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("none.mp4", MissingFileError),
        ("text.mp4", DeepDetectError),
        ("empty", ImageError),
        ("one.png", ImageError),
        ("frames.zip", ImageError),
        ("alone", ImageError),
    ],
)
def test_a_mistake_is_named(name: str, kind: type[Exception], moving_photo, tmp_path: Path) -> None:
    (tmp_path / "text.mp4").write_text("I am no video")
    (tmp_path / "empty").mkdir()
    (tmp_path / "alone").mkdir()
    Image.fromarray(moving_photo(0)).save(tmp_path / "alone" / "1.jpg")
    with zipfile.ZipFile(tmp_path / "frames.zip", "w") as archive:  # OpenCV opens it
        archive.write(tmp_path / "alone" / "1.jpg")
    Image.fromarray(moving_photo(0)).save(tmp_path / "one.png")
    with pytest.raises(kind, match=name):
        FrameSource(tmp_path / name)


@pytest.mark.parametrize("values", [{"every": 0}, {"every": 1.5}, {"max_frames": 0}])
def test_wrong_options(values, frame_folder) -> None:
    with pytest.raises(OptionError, match=next(iter(values))):
        FrameSource(frame_folder, **values)
    with pytest.raises(OptionError):
        FrameSource(-1)


def test_there_is_no_file_unless_it_is_whole(moving_photo, tmp_path: Path) -> None:
    def stopped() -> None:
        with write_video(tmp_path / "v.mp4", 10) as write:
            write(moving_photo(0))
            raise RuntimeError

    with pytest.raises(RuntimeError):
        stopped()
    with pytest.raises(DeepDetectError), write_video(tmp_path / "v.mp4", 10):
        pass
    with pytest.raises(OptionError), write_video(tmp_path / "v.gif", 10):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", sorted(CODECS))
def test_a_full_disk_is_one_sentence(suffix: str, tmp_path: Path) -> None:
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
        with pytest.raises(DeepDetectError, match=f"v{suffix}"):
            write_noise()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, usual)
    assert not list(tmp_path.iterdir())


def test_frames_of_another_size_are_refused(moving_photo, tmp_path: Path) -> None:
    with write_video(tmp_path / "v.avi", 10) as write:
        write(moving_photo(0))
        with pytest.raises(DeepDetectError):
            write(moving_photo(0)[:100])
