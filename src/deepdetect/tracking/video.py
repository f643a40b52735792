"""Read frames of a video file, a folder of images, or a camera; write frames to a video file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import (
    BatchError,
    DeepDetectError,
    ImageError,
    InvalidFileError,
    MissingFileError,
    OptionError,
)
from .._shared.opencv import cv2
from .._shared.options import check_ranges, suggest_keywords
from ..io.image import find_images, load_image, load_pixels, one_range
from ..io.image_file import IMAGE_SUFFIXES, SIGNATURE_BYTES, read_with, refuse_others
from ..io.tiff import page_numbers

FOLDER_FPS = 10.0
"""This rate, in frames per second, is assumed for folders and for videos that state no rate."""

MAX_FPS = 1000.0
"""If a file states a higher frame rate, `FOLDER_FPS` is assumed instead. Chosen by hand."""

EQUAL_FRAMES = 4
"""If this many frames equal the one before, `_SecondReader` checks that the file repeats them."""

SINGLE = "has a single frame: give a video, or a folder of frames"

CODECS = {".mp4": "mp4v", ".mov": "mp4v", ".mkv": "mp4v", ".avi": "MJPG"}


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of a video.

    Attributes:
        number: number in the source, from 0 on.
        rgb: (H, W, 3) uint8 pixels, or (H, W, 4) if some are transparent.
    """

    number: int
    rgb: np.ndarray


class FrameSource(AbstractContextManager["FrameSource"]):
    """The frames of a video file, of the images below a folder or in a file, or of a camera.

    Iterate over the source once, in a `with` block.

    Args:
        source: a video, an image file of several pages or frames, such as TIFF or GIF, a folder
            (images in the order of their names), or the number of a camera.
        every: process every N-th frame.
        max_frames: largest number of frames that are taken; None: all.

    Attributes:
        live: whether the source is a camera, which has no end.
        fps: frame rate of the frames that are taken: the source's rate divided by `every`.
        count: number of frames to take if the file states its length correctly; None if unknown.
        failures: a sentence on each image that was unreadable, or differed in size from the first.

    Raises:
        MissingFileError: there is no such file, folder or camera.
        ImageError: the folder holds no image.
        InvalidFileError: the file is not a video that can be read, or OpenCV does not decode it.
        OptionError: an option is out of its range.
    """

    @suggest_keywords
    def __init__(
        self, source: str | Path | int, *, every: int = 1, max_frames: int | None = None
    ) -> None:
        self.every, self.max_frames = every, max_frames
        check_ranges(self, counts=("every", "max_frames"))
        self.camera = _camera_number(source)
        self.live = self.camera is not None
        self._capture: Any = None
        self._images: list[tuple[Path, int | None]] = []
        self.failures: list[str] = []
        self.path = path = Path(str(source))
        fps, total = FOLDER_FPS, 0
        if not self.live and path.is_dir():
            self._images = [(each, None) for each in find_images(path)]
        elif not self.live and path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES:
            self._images = [(path, page) for page in page_numbers(path, frames=True)]
        else:
            self._capture = self._opened(str(source))
            stated = float(self._capture.get(cv2.CAP_PROP_FPS))
            fps = stated if 0 < stated <= MAX_FPS else fps
            total = 0 if self.live else int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if len(self._images) == 1:
            raise ImageError(f"{path} {SINGLE}")
        self.fps = fps / every
        taken = -(-max(0, len(self._images) or total) // every)
        self.count = min((number for number in (taken, max_frames) if number), default=None)

    def _opened(self, path: str) -> Any:
        if not self.live and not self.path.is_file():
            raise MissingFileError(f"there is no video, folder or camera {path}: check the path")
        capture = cv2.VideoCapture(self.camera if self.live else path)
        if self.live and not capture.isOpened():
            raise MissingFileError(
                f"there is no camera {self.camera}, or another program uses it: try another number"
            )
        if not self.live:  # OpenCV also opens archives of JPEG files
            with self.path.open("rb") as file:
                refuse_others(file.read(SIGNATURE_BYTES), path)
        if capture.isOpened():
            return capture
        raise InvalidFileError(
            f"the installed OpenCV cannot read {path} as a video: convert it to MP4 (H.264), or "
            "give a folder of its frames"
        )

    def __iter__(self) -> Iterator[Frame]:
        frames = self._from_images() if self._capture is None else self._from_capture()
        return islice(frames, self.max_frames)

    def _from_images(self) -> Iterator[Frame]:
        first: tuple[int, ...] = ()
        with one_range([path for path, _ in self._images[:: self.every]]) as reading:
            pass
        for number, (path, page) in list(enumerate(self._images))[:: self.every]:
            try:
                with read_with(replace(reading, page=page)):
                    rgb = load_pixels(path)
            except ImageError as error:
                self.failures.append(str(error))
                continue
            height, width = rgb.shape[:2]
            first = first or (width, height)
            if (width, height) == first:
                yield Frame(number, rgb)
            else:
                self.failures.append(
                    f"{path} has {width}x{height} pixels, the first frame has "
                    f"{first[0]}x{first[1]}: give frames of one size"
                )
        if not first:
            count = len(self.failures)
            raise BatchError(f"none of {count} frames can be read", self.failures)

    def _from_capture(self) -> Iterator[Frame]:
        last: Any = None
        equal, again = 0, _SecondReader(self.path)
        for number in count():
            wanted = number % self.every == 0
            # `grab` skips a frame without decoding it, if the format allows it.
            done, bgr = self._capture.read() if wanted else (self._capture.grab(), last)
            if not done:
                break
            if wanted:
                same = not self.live and last is not None and np.array_equal(bgr, last)
                equal, last = equal + 1 if same else 0, bgr
                if same and equal == min(EQUAL_FRAMES, (self.count or number + 2) - 1):
                    again.check(number, equal, bgr)
                yield Frame(number, load_image(bgr, channels="bgr"))
        if number == 0:
            raise DeepDetectError("the source has no frames: check it with another program")
        if number == 1:
            raise DeepDetectError(f"{self.path} {SINGLE}")
        if equal and equal == (number - 1) // self.every:
            again.check(equal * self.every, equal, last, black=False)

    def __exit__(self, *_: object) -> None:
        if self._capture is not None:
            self._capture.release()


class _SecondReader:
    """Another reader of a video, which tells whether equal frames are equal in the file.

    The conversion of interlaced frames fails in OpenCV 4.14 and 5.0, which then return the previous
    contents of the memory. The second reader's memory is new, or holds another frame.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._grabbed = path, 0

    @cached_property
    def _video(self) -> Any:
        return cv2.VideoCapture(str(self._path))

    def check(self, number: int, equal: int, bgr: np.ndarray, *, black: bool = True) -> None:
        """Raise an error if the second reader gives other pixels than `bgr` for frame `number`.

        `equal` is the number of repeats. Unless `black`, black frames also fail: new memory is 0.
        """
        for _ in range(self._grabbed, number + 1):
            self._video.grab()
        self._grabbed = max(self._grabbed, number + 1)
        if not np.array_equal(self._video.retrieve()[1], bgr) or not (black or bgr.any()):
            raise InvalidFileError(
                f"{equal + 1} frames of {self._path}, up to number {number}, are equal, but should "
                "not be: the installed OpenCV may fail with interlaced videos; convert it, such as "
                f'by ffmpeg -i "{self._path}" -vf yadif progressive.mp4'
            )


def _camera_number(source: str | Path | int) -> int | None:
    if isinstance(source, int):
        if source < 0:
            raise OptionError(f"the number of a camera must be 0 or more, not {source}")
        return source
    text = str(source)
    match = re.fullmatch(r"(/dev/video)?([0-9]+)", text)
    return int(match[2]) if match and (match[1] or not Path(text).exists()) else None


def _undecoded(path: Path) -> Any:
    """Open a video to count its packets, which takes a fiftieth of the time of decoding frames."""
    if cv2.CAP_FFMPEG not in cv2.videoio_registry.getBackends():
        return cv2.VideoCapture(str(path))
    return cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])


def check_video_name(path: str | Path) -> str:
    """Return the codec for the suffix of a video file, or raise an OptionError."""
    suffix = Path(path).suffix.lower()
    if suffix not in CODECS:
        raise OptionError(f"{path} must end in {', '.join(CODECS)}, or .csv")
    return CODECS[suffix]


@contextmanager
def write_video(path: str | Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Open a video file; the file appears only if the block ends without an error.

    The block gets a function that writes a (H, W, 3) uint8 RGB frame; all frames must have the same
    size. The finished file is checked, because OpenCV does not report frames that it cannot write.

    Raises:
        DeepDetectError: the file cannot be written (the disk may be full), or has no frames.
    """
    codec = check_video_name(path)
    sizes: list[tuple[int, int]] = []
    with atomic_path(path) as temporary:
        writer = cv2.VideoWriter()

        def write(rgb: np.ndarray) -> None:
            size = rgb.shape[1], rgb.shape[0]
            if not sizes:
                writer.open(str(temporary), cv2.VideoWriter_fourcc(*codec), fps, size)
                if not writer.isOpened():
                    raise DeepDetectError(
                        f"the installed OpenCV has no encoder ({codec}) for {path}: give a name "
                        "that ends in .avi, or in .csv for only the tracks"
                    )
            elif size != sizes[0]:
                raise DeepDetectError(f"a frame has {size} pixels, but the first had {sizes[0]}")
            writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
            sizes.append(size)

        try:
            yield write
        finally:
            writer.release()
        if not sizes:
            raise DeepDetectError(f"there are no frames to write to {path}: check the source")
        written = _undecoded(temporary)
        found = next(number for number in count() if not written.grab())
        written.release()
        if found < len(sizes):
            raise DeepDetectError(
                f"cannot write {path} ({found} of {len(sizes)} frames are in the file): free "
                "some space, or choose another place"
            )
