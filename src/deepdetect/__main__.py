"""`python -m deepdetect` and the command `deepdetect`."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

OPENCV_SETTINGS = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
"""Errors are one sentence, without lines of OpenCV and of its FFmpeg beside it.

Both are read from the environment when OpenCV is loaded, and a user's own setting stays. Programs
that import this package are left as they are.
"""


def main() -> None:
    """Run the command line; Ctrl-C ends it with exit code 130, while packages are imported, too."""
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True
        raise KeyboardInterrupt

    for name, value in OPENCV_SETTINGS.items():
        os.environ.setdefault(name, value)
    # Packages that are interrupted while they are imported raise what they like.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, stop)
    try:
        from .cli import main as command

        code = command()
        if not stopped or code in (0, STOPPED):
            sys.exit(code)
    except SystemExit as error:
        if not stopped or error.code in (None, 0, STOPPED):
            raise
    except BaseException:
        if not stopped:
            raise
    if stopped:
        print("deepdetect: stopped; what was written stays", file=sys.stderr)
        sys.exit(STOPPED)


STOPPED = 130
"""Exit code after Ctrl-C."""

if __name__ == "__main__":
    main()
