"""Tracks of points in a video: their CSV file, and drawings over the frames."""

from __future__ import annotations

import colorsys
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import InvalidFileError, MissingFileError, OptionError, first_line
from .._shared.opencv import cv2
from ..viz.draw import line_scale

HEADER = "frame,track,x,y,score"

HUE_STEP = 0.61803
"""The hue advances by this fraction of the colour circle from each track to the next: the golden
ratio, which gives successive tracks clearly different colours."""


@dataclass(frozen=True, eq=False)
class TrackedFrame:
    """The tracked points of one frame.

    Attributes:
        number: number of the frame in the source, from 0 on.
        tracks: (N,) int64 track numbers, ascending; a track keeps its number in all frames.
        xy: (N, 2) float32 positions in pixels; the centre of the first pixel is (0, 0).
        scores: (N,) float32 scores of the keypoints with which the tracks began.
        ages: (N,) int64 numbers of frames since each track began; 0: it begins in this frame.

    Raises:
        OptionError: the arrays do not have one row for each track.
    """

    number: int
    tracks: np.ndarray
    xy: np.ndarray
    scores: np.ndarray
    ages: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.tracks)
        shapes = [np.shape(values) for values in (self.xy, self.scores, self.ages)]
        if shapes != [(count, 2), (count,), (count,)]:
            raise OptionError(
                f"{count} tracks need positions (N, 2), scores (N,) and ages (N,), not {shapes}"
            )

    def __len__(self) -> int:
        return len(self.tracks)


@contextmanager
def write_tracks(path: str | Path) -> Iterator[Callable[[TrackedFrame], None]]:
    """Open a CSV file of tracks; the file appears only if the block ends without an error.

    The block gets a function that writes the rows of a frame: frame, track, x, y and score.
    """
    if Path(path).suffix.lower() != ".csv":
        raise OptionError(f"{path} must end in .csv")
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii") as file:
        file.write(f"{HEADER}\n")

        def write(frame: TrackedFrame) -> None:
            rows = zip(frame.tracks.tolist(), frame.xy.tolist(), frame.scores.tolist(), strict=True)
            file.writelines(
                f"{frame.number},{track},{x:.3f},{y:.3f},{score:.6g}\n"
                for track, (x, y), score in rows
            )

        yield write


def load_tracks(path: str | Path) -> list[TrackedFrame]:
    """Read the CSV file that `deepdetect track` wrote.

    Returns:
        The frames that have tracks, in order.

    Raises:
        DeepDetectError: the file is missing or not a file of tracks.

    Example:
        >>> import tempfile
        >>> frame = TrackedFrame(4, np.array([7]), np.array([[1.5, 2]]), np.ones(1), np.zeros(1))
        >>> path = Path(tempfile.mkdtemp()) / "tracks.csv"
        >>> with write_tracks(path) as write:
        ...     write(frame)
        >>> load_tracks(path)[0].xy.tolist()
        [[1.5, 2.0]]
    """
    try:
        with Path(path).open(encoding="ascii") as file:
            if file.readline().strip() != HEADER:
                raise ValueError(f"its first line is not {HEADER}")
            lines = [line.split(",") for line in file]
            table = np.array(lines, float).reshape(len(lines), len(HEADER.split(",")))
            if not np.isfinite(table).all():
                raise ValueError("a number is not finite")
    except FileNotFoundError:
        raise MissingFileError(f"there is no file {path}: check the path") from None
    except (OSError, ValueError) as error:
        raise InvalidFileError(
            f"{path} is not a file of tracks ({first_line(error)}): write the file again"
        ) from None
    if not len(table):
        return []
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    numbers, begins = np.unique(table[:, 0].astype(np.int64), return_index=True)
    born: dict[int, int] = {}
    frames = []
    parts = np.split(table, begins[1:])
    for place, (number, part) in enumerate(zip(numbers.tolist(), parts, strict=True)):
        tracks = part[:, 1].astype(np.int64)
        ages = np.array([place - born.setdefault(track, place) for track in tracks.tolist()])
        xy, scores = part[:, 2:4].astype(np.float32), part[:, 4].astype(np.float32)
        frames.append(TrackedFrame(number, tracks, xy, scores, ages))
    return frames


class TrackDrawer:
    """Draws tracks over frames, each with its last `tail` positions."""

    def __init__(self, tail: int = 10) -> None:
        self._frames: deque[TrackedFrame] = deque(maxlen=tail)

    def draw(self, rgb: np.ndarray, frame: TrackedFrame, caption: str = "") -> np.ndarray:
        """Return a copy of a frame, (H, W, 3) uint8, with its tracks and a caption."""
        self._frames.append(frame)
        canvas = np.ascontiguousarray(rgb.copy())
        unit = line_scale(rgb)
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
    """Return a bright RGB colour for a track number."""
    red, green, blue = colorsys.hsv_to_rgb(track * HUE_STEP % 1, 0.8, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)
