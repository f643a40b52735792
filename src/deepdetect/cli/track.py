"""`deepdetect track`: points followed through a video."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._shared.errors import OptionError
from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    PATH,
    check_inputs_survive,
    json_option,
    max_megapixels_option,
    overwrite_option,
    print_result,
    report_failures,
)

if TYPE_CHECKING:
    from ..tracking.pipeline import TrackingReport

TRACKING = FieldOptions("tracking.tracker:TrackingOptions")
FRAMES = FieldOptions(
    "tracking.pipeline:track",
    names=("every", "max_frames", "max_side", "tail"),
    defaults={"max_frames": "all", "max_side": "no limit"},
)


@generated_command(TRACKING, FRAMES, short_help="Points followed through a video.")
@click.argument("source", metavar="VIDEO|FOLDER|CAMERA")
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("tracks.mp4"),
    show_default=True,
    help="Video to be written (.mp4, .mov, .mkv, .avi); or .csv for the table of tracks alone.",
)
@max_megapixels_option
@overwrite_option
@json_option
def track(source: str, output: Path, overwrite: bool, as_json: bool, **values: Any) -> None:
    """Follow keypoints through a video file, a folder of frames, or the camera of this number.

    Writes a video with the points, their last positions and the frames per second of the work, and
    beside it a table of all tracks (.csv): frame, track, x, y, score. Ctrl-C, SIGTERM or SIGHUP on
    a camera ends the recording, and both files are written. An image of a folder that cannot be
    read, or has another size than the first one, does not stop the others: they are listed at the
    end, with exit code 1.

    \b
    deepdetect track drive.mp4 -o tracks.mp4
    deepdetect track frames/ -o tracks.mp4 --max-keypoints 500
    deepdetect track 0 -o webcam.mp4 --max-side 640
    """
    from ..tracking.frames import FrameSource
    from ..tracking.pipeline import output_files
    from ..tracking.pipeline import track as track_points
    from ..tracking.tracker import TrackingOptions
    from ._records import claimed_outputs

    files = [path for path in output_files(output) if path is not None]
    given = given_only(values)
    frames = {name: given.pop(name) for name in FRAMES.names if name in given}
    options = TrackingOptions(**given)
    with FrameSource(source) as opened:
        live = opened.live
    claim: AbstractContextManager[None] = nullcontext()
    if live:
        for path in files if not overwrite else ():
            if path.exists():
                raise OptionError(
                    f"{path} exists, of an earlier recording: choose another name with -o, or "
                    "replace it with --overwrite"
                )
    else:
        inputs = [Path(source)]
        if inputs[0].is_file():
            check_inputs_survive(files, inputs, "choose another name with -o")
        claim = claimed_outputs("track", inputs, files, overwrite)
    with claim:
        report = track_points(source, output, options=options, quiet=False, **frames)
    print_result(
        as_json,
        vars(report),
        [
            ("frames", _frames_text(report)),
            ("tracks", f"{report.tracks:,}"),
            ("tracks per frame", f"{report.tracks_per_frame:.0f}"),
            ("frames per track", f"{report.frames_per_track:.1f}"),
            ("frames per second", f"{report.fps:.1f}"),
            ("written", ", ".join(str(path) for path in report.files)),
        ],
        str(source),
    )
    report_failures(report.failures, report.frames + len(report.failures), "frames")


def _frames_text(report: TrackingReport) -> str:
    """Return the number of frames, and how many the source states where these are more."""
    found = report.frames + len(report.failures)
    if report.expected is None or found >= report.expected:
        return f"{report.frames:,}"
    return f"{report.frames:,}; the file states {report.expected:,}, and may be cut off"
