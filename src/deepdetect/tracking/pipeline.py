"""From a video, a folder or a camera to a video of the tracks and their table."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import OptionError
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from .._shared.progress import progress
from .._shared.signals import ENDING, exit_by_signal, handle_signals
from ..detector.detector import Detector
from ..detector.point_detector import PointDetector
from ..io.image_file import is_path
from .tracker import CANDIDATES, Detect, Tracker, TrackingOptions
from .tracks import TrackDrawer, TrackedFrame, write_tracks
from .video import Frame, FrameSource, check_video_name, write_video

MIN_SIDE_PX = 32
"""Smallest longer side that frames are scaled down to."""

RATE_FRAMES = 10
"""Frames of which the number per second is shown."""


@dataclass(frozen=True)
class TrackingReport:
    """What was tracked.

    Attributes:
        frames: number of frames.
        tracks: number of tracks.
        tracks_per_frame: on average.
        frames_per_track: on average.
        fps: frames per second of the work, drawing and writing included.
        seconds: of all the work.
        files: that were written.
        expected: number of frames that the source states, or None; a file cut off gives fewer.
        failures: a sentence on each frame of a folder that was left out.
    """

    frames: int
    tracks: int
    tracks_per_frame: float
    frames_per_track: float
    fps: float
    seconds: float
    files: tuple[Path, ...]
    expected: int | None = None
    failures: tuple[str, ...] = ()


def point_candidates(options: TrackingOptions = TrackingOptions()) -> Detect:
    """Return what finds the best points of a frame, as a `Tracker` wants it."""
    return PointDetector(CANDIDATES * options.max_keypoints).detect


@suggest_keywords
def track_frames(
    source: FrameSource, tracker: Tracker, *, max_side: int | None = None
) -> Iterator[tuple[np.ndarray, TrackedFrame]]:
    """Follow points through all frames of a source.

    Args:
        source: opened in a `with` block.
        tracker: a new one.
        max_side: longer sides of frames are scaled down to this for the tracker, in pixels.

    Returns:
        Iterator over each frame, (H, W, 3) uint8 RGB, and its tracks, in pixels of this frame.

    Raises:
        OptionError: `max_side` is too small.
        BatchError: no frame of a folder can be read.
    """
    if max_side is not None and not max_side >= MIN_SIDE_PX:
        raise OptionError(f"`max_side` must be at least {MIN_SIDE_PX} pixels, not {max_side}")
    return ((frame.rgb, _tracked(tracker, frame, max_side)) for frame in source)


def _tracked(tracker: Tracker, frame: Frame, max_side: int | None) -> TrackedFrame:
    height, width = frame.rgb.shape[:2]
    if max_side is None or max(height, width) <= max_side:
        return tracker.update(frame.rgb, number=frame.number)
    factor = max_side / max(height, width)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    small = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA)
    found = tracker.update(small, number=frame.number)
    xy = (found.xy + 0.5) * np.divide((width, height), size) - 0.5
    return replace(found, xy=xy.astype(np.float32))


@suggest_keywords
def track(
    source: str | Path | int,
    output: str | Path,
    *,
    detector: Detector | None = None,
    options: TrackingOptions = TrackingOptions(),
    every: int = 1,
    max_frames: int | None = None,
    max_side: int | None = None,
    tail: int = 10,
    quiet: bool = True,
) -> TrackingReport:
    """Follow the points of a video, and write a video with the tracks, and their table.

    Ctrl-C, SIGTERM or SIGHUP (of a terminal that is closed) on a camera ends the recording; both
    files are written. An image of a folder that cannot be read, or has another size than the first
    one, does not stop the others: it is named in the report.

    Args:
        source: a video file, a folder of images, or the number of a camera.
        output: ending in .mp4, .mov, .mkv or .avi; the table beside it ends in .csv, with columns
            frame, track, x, y and score. With .csv itself there is no video.
        detector: that finds the points; None: a `PointDetector` of enough candidates.
        options: how they are followed.
        every: process every N-th frame.
        max_frames: largest number of frames that are taken. None: all.
        max_side: longer sides of frames are scaled down to this many pixels for the search.
        tail: number of positions of a track that are drawn.
        quiet: show no progress bar.

    Returns:
        What was tracked.

    Raises:
        DeepDetectError: the source cannot be read, files cannot be written, or an option is wrong.

    Example:
        >>> track("drive.mp4", "tracks.mp4")  # doctest: +SKIP
    """
    video, table = output_files(output)
    made = [path.resolve() for path in (video, table) if path is not None]
    if is_path(source) and Path(str(source)).resolve() in made:
        raise OptionError(f"{source} is the video itself: give another output")
    if tail < 1:
        raise OptionError(f"`tail` must be at least 1, not {tail}")
    frames = tracks = positions = 0
    begun = time.perf_counter()
    with ExitStack() as stack:
        opened = stack.enter_context(FrameSource(source, every=every, max_frames=max_frames))
        detect = point_candidates(options) if detector is None else detector.detect
        tracker = Tracker(detect, options)
        stopped = stack.enter_context(_ended_by_signals(opened.live))
        write = stack.enter_context(write_tracks(table))
        draw = None if video is None else stack.enter_context(write_video(video, opened.fps))
        drawer, ticks = TrackDrawer(tail), deque([begun], RATE_FRAMES + 1)
        tracked = track_frames(opened, tracker, max_side=max_side)
        bar = stack.enter_context(progress(opened.count, "tracking", "frame", quiet))
        for rgb, frame in tracked:
            write(frame)
            ticks.append(time.perf_counter())
            rate = (len(ticks) - 1) / max(1e-9, ticks[-1] - ticks[0])
            if draw is not None:
                draw(drawer.draw(rgb, frame, f"{rate:.1f} frames/s   {len(frame)} tracks"))
            frames += 1
            tracks = max(tracks, int(frame.tracks.max(initial=-1)) + 1)
            positions += len(frame)
            bar.update()
            bar.set_postfix_str(f"{len(frame)} tracks", refresh=False)
            if stopped():
                break
    seconds = time.perf_counter() - begun
    return TrackingReport(
        frames,
        tracks,
        positions / max(1, frames),
        positions / max(1, tracks),
        frames / seconds,
        seconds,
        tuple(path for path in (video, table) if path is not None),
        opened.count,
        tuple(opened.failures),
    )


def output_files(output: str | Path) -> tuple[Path | None, Path]:
    """Return the files of the video, None where there is none, and of the table."""
    path = Path(output)
    if path.suffix.lower() == ".csv":
        return None, path
    check_video_name(path)
    return path, path.with_suffix(".csv")


@contextmanager
def _ended_by_signals(live: bool) -> Iterator[Callable[[], bool]]:
    """Note the first Ctrl-C, SIGTERM or SIGHUP of a live source, so that its files are finished.

    A second one ends all at once, and leaves no file.
    """
    noted: list[int] = []
    with ExitStack() as handlers:

        def note(number: int, _: Any) -> None:
            noted.append(number)
            handlers.close()
            handlers.enter_context(handle_signals(exit_by_signal))

        if live:
            handlers.enter_context(handle_signals(note, ("SIGINT", *ENDING)))
        yield lambda: bool(noted)
