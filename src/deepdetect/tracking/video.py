"""Video files of the tracked points."""

from __future__ import annotations

import colorsys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError, OptionError
from .._shared.opencv import cv2
from .tracks import TrackedFrame

CODECS = {".mp4": "mp4v", ".mov": "mp4v", ".mkv": "mp4v", ".avi": "MJPG"}
"""Of the files, by their suffix."""

READABLE_WIDTH_PX = 800
"""Lines and letters grow with frames that are wider than this."""

HUE_STEP = 0.61803
"""Of the colours of following tracks: neighbours are far apart (the golden ratio)."""


def count_frames(path: Path) -> int:
    """Return how many frames of a video file can be read one after the other."""
    backend, settings = cv2.CAP_ANY, []
    if cv2.CAP_FFMPEG in cv2.videoio_registry.getBackends():
        # It can leave frames undecoded, which takes a fiftieth of the time.
        backend, settings = cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1]
    capture, count = cv2.VideoCapture(str(path), backend, settings), 0
    while capture.grab():
        count += 1
    capture.release()
    return count


def check_video_name(path: str | Path) -> str:
    """Return the codec of a video file by its suffix; call it before any expensive work."""
    suffix = Path(path).suffix.lower()
    if suffix not in CODECS:
        raise OptionError(f"{path} must end in {', '.join(CODECS)}, or .csv")
    return CODECS[suffix]


@contextmanager
def write_video(path: str | Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """Open a video file, which appears when the block ends, whole or not at all.

    What writes a (H, W, 3) uint8 RGB frame is given; all have the size of the first. OpenCV does
    not say when a frame could not be written: the whole file is checked.

    Raises:
        DeepDetectError: the file cannot be written, as where the disk is full, or no frame was.
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
                        "that ends in .avi, or in .csv for the tracks alone"
                    )
            elif size != sizes[0]:
                raise DeepDetectError(f"a frame has {size} pixels, the first one had {sizes[0]}")
            writer.write(cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
            sizes.append(size)

        try:
            yield write
        finally:
            writer.release()
        if not sizes:
            raise DeepDetectError(f"there is no frame to be written to {path}: check the source")
        if (found := count_frames(temporary)) < len(sizes):
            raise DeepDetectError(
                f"cannot write {path} ({found} of {len(sizes)} frames are in the file): free "
                "some space, or choose another place"
            )


class TrackDrawer:
    """Draws tracks with their last positions, up to `tail`, over frames."""

    def __init__(self, tail: int = 10) -> None:
        self._frames: deque[TrackedFrame] = deque(maxlen=tail)

    def draw(self, rgb: np.ndarray, frame: TrackedFrame, caption: str = "") -> np.ndarray:
        """Return a copy of a frame, (H, W, 3) uint8, with its tracks and a caption."""
        self._frames.append(frame)
        canvas = np.ascontiguousarray(rgb.copy())
        unit = max(1.0, rgb.shape[1] / READABLE_WIDTH_PX)
        colors = {track: track_color(track) for track in frame.tracks.tolist()}
        tails: dict[int, list[list[float]]] = {}
        for past in self._frames:
            for track, place in zip(past.tracks.tolist(), past.xy.tolist(), strict=True):
                if track in colors:
                    tails.setdefault(track, []).append(place)
        for track, places in tails.items():
            line = np.rint(np.array(places)).astype(np.int32).reshape(-1, 1, 2)
            cv2.polylines(canvas, [line], False, colors[track], max(1, round(unit)), cv2.LINE_AA)
            end = (int(line[-1, 0, 0]), int(line[-1, 0, 1]))
            cv2.circle(canvas, end, round(2 * unit), colors[track], -1, cv2.LINE_AA)
        if caption:
            place, font = (round(8 * unit), round(22 * unit)), cv2.FONT_HERSHEY_SIMPLEX
            for color, width in (((0, 0, 0), 4), ((255, 255, 255), 1)):
                style = font, 0.6 * unit, color, round(width * unit), cv2.LINE_AA
                cv2.putText(canvas, caption, place, *style)
        return canvas


def track_color(track: int) -> tuple[int, int, int]:
    """Return a bright RGB colour that a track keeps."""
    red, green, blue = colorsys.hsv_to_rgb(track * HUE_STEP % 1, 0.8, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)
