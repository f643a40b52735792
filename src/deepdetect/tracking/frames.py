"""Frames one after the other: of a video file, a folder of images, or a camera."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from .._shared.errors import (
    BatchError,
    DeepDetectError,
    ImageError,
    InvalidFileError,
    MissingFileError,
    OptionError,
)
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from ..io.image import IMAGE_SUFFIXES, find_images, load_image

FOLDER_FPS = 10.0
"""Of the frames in a folder, which say nothing of it."""

MAX_FPS = 1000.0
"""What a file states above it is wrong."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame.

    Attributes:
        number: in the source, from 0 on.
        rgb: (H, W, 3) uint8.
    """

    number: int
    rgb: np.ndarray


class FrameSource(AbstractContextManager["FrameSource"]):
    """The frames of a video file, of the images below a folder, or of a camera.

    It is iterated once, in a `with` block.

    Args:
        source: a file, a folder (images in the order of their names), or the number of a camera.
        every: take each frame with a number that this divides.
        max_frames: that are taken; None: all.

    Attributes:
        live: whether it is a camera, which has no end.
        fps: frames per second of what is taken.
        count: number of frames that will be taken, as far as the file states it; None where it is
            not known.
        failures: a sentence on each image of a folder that was left out until now: it cannot be
            read, or has another size than the first one.

    Raises:
        MissingFileError: there is no such file, folder or camera.
        ImageError: the folder holds no image.
        InvalidFileError: the file is no video that can be read.
        OptionError: an option is out of its range.
    """

    @suggest_keywords
    def __init__(
        self, source: str | Path | int, *, every: int = 1, max_frames: int | None = None
    ) -> None:
        for name, value in (("every", every), ("max_frames", max_frames)):
            if value is not None and (value < 1 or value % 1):
                raise OptionError(f"`{name}` must be a whole number from 1 on, not {value}")
        self.every, self.max_frames = every, max_frames
        self.camera = _camera_number(source)
        self.live = self.camera is not None
        self._capture: Any = None
        self._images: list[Path] = []
        self.failures: list[str] = []
        total: int | None = None
        fps = FOLDER_FPS
        path = Path(str(source))
        if not self.live and path.is_dir():
            self._images = find_images(path)
            total = len(self._images)
        else:
            self._capture = self._opened(path)
            stated = float(self._capture.get(cv2.CAP_PROP_FPS))
            if 0 < stated <= MAX_FPS:
                fps = stated
            counted = float(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
            total = int(counted) if not self.live and counted > 0 else None
        self.fps = fps / every
        taken = None if total is None else -(-total // every)
        known = [number for number in (taken, max_frames) if number is not None]
        self.count = min(known) if known else None

    def _opened(self, path: Path) -> Any:
        """Open a file or a camera by OpenCV."""
        if self.live:
            capture = cv2.VideoCapture(self.camera)
            if not capture.isOpened():
                raise MissingFileError(
                    f"there is no camera {self.camera}, or another program uses it: try another "
                    "number, or close that program"
                )
            return capture
        if not path.is_file():
            raise MissingFileError(f"there is no video, folder or camera {path}: check the path")
        if path.suffix.lower() in IMAGE_SUFFIXES:
            raise ImageError(f"{path} is one image: give a video, or the folder of the frames")
        capture = cv2.VideoCapture(str(path))
        if not capture.isOpened():
            raise InvalidFileError(
                f"{path} is no video that the installed OpenCV can read: convert it to MP4 "
                "(H.264), or give a folder of its frames"
            )
        return capture

    def __iter__(self) -> Iterator[Frame]:
        frames = self._from_images() if self._capture is None else self._from_capture()
        for taken, frame in enumerate(frames, 1):
            yield frame
            if taken == self.max_frames:
                return

    def _from_images(self) -> Iterator[Frame]:
        first: tuple[int, ...] = ()
        for number, path in list(enumerate(self._images))[:: self.every]:
            try:
                rgb = load_image(path)
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
        number = 0
        while True:
            wanted = number % self.every == 0
            # What is not wanted is not decoded where the format allows it.
            done, bgr = self._capture.read() if wanted else (self._capture.grab(), None)
            if not done:
                break
            if wanted:
                yield Frame(number, load_image(bgr, channels="bgr"))
            number += 1
        if not number:
            raise DeepDetectError("the source gives no frame: check it with another program")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if self._capture is not None:
            self._capture.release()


def _camera_number(source: str | Path | int) -> int | None:
    """Return the number of a camera, None where a path is meant."""
    if isinstance(source, int):
        if source < 0:
            raise OptionError(f"the number of a camera must be 0 or more, not {source}")
        return source
    text = str(source)
    return int(text) if text.isascii() and text.isdigit() and not Path(text).exists() else None
