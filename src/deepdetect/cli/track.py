"""`deepdetect track`: points tracked through a video."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from .._shared.errors import OptionError
from .._shared.records import Outputs
from ..tracking.pipeline import output_files
from ..tracking.pipeline import track as track_points
from ..tracking.tracker import TrackingOptions
from ..tracking.video import FrameSource
from . import _options as cli

TRACKING = cli.From(TrackingOptions, "max_keypoints")
FRAMES = cli.From(
    track_points,
    "every max_frames max_side",
    more="tail",
    defaults={"max_frames": "all", "max_side": "no limit"},
)


@cli.command(FRAMES, TRACKING, cli.READING)
def track(
    source: Annotated[str, Parameter(help="Video, stack or folder of frames, or camera number.")],
    /,
    *,
    output: cli.Output = Path("tracks.mp4"),
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Track keypoints through a video, a TIFF of frames, a folder, or the images of a camera.

    Writes a video that shows the points, their last positions and the frames processed per second,
    and a table of all tracks (.csv) with the columns frame, track, x, y and score. A recording of a
    camera runs until Ctrl+C, SIGTERM or SIGHUP ends it; both files are then finished. If images of
    a folder cannot be read or differ in size, they are listed at the end, and the exit code is 1.

        deepdetect track drive.mp4 -o tracks.mp4
        deepdetect track frames/ -o tracks.mp4 --max-keypoints 500
        deepdetect track 0 -o webcam.mp4 --max-side 640

    Args:
        output: Video file (.mp4, .mov, .mkv or .avi), with the table next to it; a .csv file for
            the table only; or a folder for both.
    """
    file = cli.output_file(output, "tracks.mp4")
    files = [path for path in output_files(file) if path is not None]
    frames = FRAMES.take(values)
    options = TrackingOptions(**values)
    with FrameSource(source) as opened:
        live = opened.live
    for path in files if live and not overwrite else ():
        if path.exists():
            raise OptionError(
                f"{path} is an earlier recording: choose another -o, or --overwrite it"
            )
    if Path(source).is_file():
        cli.check_outputs(files, [Path(source)])
    outputs = Outputs(files, [Path(source)], overwrite=overwrite)
    with nullcontext() if live else cli.claimed(outputs):
        report = track_points(source, file, options=options, quiet=False, **frames)
    total = report.frames + len(report.failures)
    if report.expected is not None and total < report.expected:
        cli.say(f"the file should have {report.expected:,} frames: it may be truncated")
    code = 0 if report.tracks or live else cli.NOTHING_FOUND
    sentence = f"{report.tracks:,} tracks in {report.frames:,} frames"
    names = "tracks_per_frame frames_per_track fps seconds files"
    text = cli.headed(sentence, vars(report), names)
    return cli.Result(vars(report), text, report.failures, total, "frames", code)
