"""Track points in a video, a folder or a camera; write a video with the tracks and a CSV file."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.alpha import opaque_part
from .._shared.errors import OptionError
from .._shared.opencv import cv2
from .._shared.options import suggest_keywords
from .._shared.progress import progress
from .._shared.signals import ENDING, exit_by_signal, handle_signals
from ..detector.detector import Detector
from ..detector.point_detector import PointDetector
from ..io.image import luma
from ..io.image_file import is_path
from ..matching.overlay import find_overlay, tell_still
from .tracker import CANDIDATES, Detect, Tracker, TrackingOptions
from .tracks import TrackDrawer, TrackedFrame, write_tracks
from .video import Frame, FrameSource, check_video_name, write_video

MIN_SIDE_PX = 32
"""`max_side`, the longer side of scaled frames, must be at least this. Chosen by hand."""

COMPARED_FRAMES, MAX_STEP = 8, 15
"""An overlay is searched for in COMPARED_FRAMES frames: before the tracking, or, for a camera, once
these frames have been recorded. The frames are at most MAX_STEP apart, half a second of most
videos, so that they show the same places."""

RATE_FRAMES = 10
"""The displayed frame rate is a mean over this number of frames."""


@dataclass(frozen=True)
class TrackingReport:
    """Statistics of a tracked video.

    Attributes:
        frames: number of frames.
        tracks: number of tracks.
        tracks_per_frame: mean number of tracks in a frame.
        frames_per_track: mean length of a track in frames.
        fps: frames processed per second, including drawing and writing.
        seconds: total time.
        files: files that were written.
        expected: number of frames that the source states, or None. A truncated file gives fewer.
        failures: a sentence on each frame of a folder that was left out.
        left_out: share of each frame that was ignored because it stands still, as captions do.
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
    left_out: float = 0.0


def point_candidates(options: TrackingOptions = TrackingOptions()) -> Detect:
    """Return a detector for a `Tracker`: `CANDIDATES` points of a frame for each possible track."""
    return PointDetector(CANDIDATES * options.max_keypoints).detect


@suggest_keywords
def track_frames(
    source: FrameSource, tracker: Tracker, *, max_side: int | None = None
) -> Iterator[tuple[np.ndarray, TrackedFrame]]:
    """Follow points through all frames of a source.

    Args:
        source: a source that was opened in a `with` block.
        tracker: a new tracker.
        max_side: larger frames are scaled for the tracker to this longer side. None: no scaling.

    Returns:
        Iterator over pairs of a frame, (H, W, 3) uint8 RGB, and its tracks. Positions are in pixels
        of this frame, not of the scaled one.

    Raises:
        OptionError: `max_side` is too small.
        BatchError: no frame of a folder can be read.
    """
    if max_side is not None and not max_side >= MIN_SIDE_PX:
        raise OptionError(f"`max_side` must be at least {MIN_SIDE_PX} pixels, not {max_side}")
    return ((opaque_part(frame.rgb)[0], _tracked(tracker, frame, max_side)) for frame in source)


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
    """Follow the points of a video; write a video with the tracks, and a CSV file of them.

    A recording of a camera runs until Ctrl-C, SIGTERM or SIGHUP (a closed terminal) ends it; both
    files are then finished. Images of a folder that cannot be read, or differ in size from the
    first one, are left out and named in the report.

    Args:
        source: a video file, a folder of images, or the number of a camera.
        output: video ending in .mp4, .mov, .mkv or .avi; the CSV file next to it has the columns
            frame, track, x, y and score. If it ends in .csv, no video is written.
        detector: detector of points. None: a `PointDetector` of `CANDIDATES` points per track.
        options: how points are followed.
        every: process every N-th frame.
        max_frames: largest number of frames that are taken. None: all.
        max_side: for the tracking only, scale larger frames to this longer side. None: no limit.
        tail: number of positions that are drawn of each track: the latest ones.
        quiet: show no progress bar.

    Returns:
        Statistics of the tracks.

    Raises:
        DeepDetectError: the source cannot be read, files cannot be written, or an option is wrong.

    Example:
        >>> track("drive.mp4", "tracks.mp4")  # doctest: +SKIP
    """
    video, table = output_files(output)
    made = [path.resolve() for path in (video, table) if path is not None]
    if is_path(source) and Path(str(source)).resolve() in made:
        raise OptionError(f"{source} is also the output: give another output")
    if tail < 1:
        raise OptionError(f"`tail` must be at least 1, not {tail}")
    frames = tracks = positions = 0
    begun = time.perf_counter()
    with ExitStack() as stack:
        opened = stack.enter_context(FrameSource(source, every=every, max_frames=max_frames))
        detect = point_candidates(options) if detector is None else detector.detect
        tracker = Tracker(detect, options)
        if not opened.live:
            tracker.ignore = _told_overlay(_compared_frames(source, every))
        seen: list[np.ndarray] = []
        stopped = stack.enter_context(_ended_by_signals(opened.live))
        write = stack.enter_context(write_tracks(table))
        draw = None if video is None else stack.enter_context(write_video(video, opened.fps))
        drawer, ticks = TrackDrawer(tail), deque([begun], RATE_FRAMES + 1)
        tracked = track_frames(opened, tracker, max_side=max_side)
        bar = stack.enter_context(progress(opened.count, "tracking", "frame", quiet))
        for rgb, frame in tracked:
            write(frame)
            if opened.live and frames % MAX_STEP == 0 and len(seen) < COMPARED_FRAMES:
                seen.append(luma(rgb))
                if len(seen) == COMPARED_FRAMES:
                    tracker.ignore = _told_overlay(seen)
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
        0.0 if tracker.ignore is None else float(tracker.ignore.mean()),
    )


def _compared_frames(source: str | Path | int, every: int) -> list[np.ndarray]:
    """Return the first frames of a file or folder as luma, to search them for an overlay."""
    with FrameSource(source) as whole:
        step = min(MAX_STEP, max(1, (whole.count or 0) // COMPARED_FRAMES))
    with FrameSource(source, every=step * every, max_frames=COMPARED_FRAMES) as some:
        return [luma(frame.rgb) for frame in some]


def _told_overlay(grays: list[np.ndarray]) -> np.ndarray | None:
    """Return the mask of an overlay in frames, or None; warn if there is an overlay."""
    overlay = find_overlay(grays)
    tell_still(float(overlay.mean()))
    return overlay if overlay.any() else None


def output_files(output: str | Path) -> tuple[Path | None, Path]:
    """Return the paths of the video (None if `output` ends in .csv) and of the CSV file."""
    path = Path(output)
    if path.suffix.lower() == ".csv":
        return None, path
    check_video_name(path)
    return path, path.with_suffix(".csv")


@contextmanager
def _ended_by_signals(live: bool) -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether a signal has asked to end the recording of a camera.

    The first signal is only noted, so that the files are finished. The second ends the process.
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
