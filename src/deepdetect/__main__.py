"""`python -m deepdetect` and the command `deepdetect`."""

from __future__ import annotations

import io
import os
import sys

from ._shared.progress import STDERR, fails
from ._shared.signals import noted_interrupts

OPENCV_SETTINGS = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
"""These variables keep OpenCV and its FFmpeg from printing lines next to our error messages.

OpenCV reads them from the environment when it is loaded. A user's own setting stays, and programs
that import this package are not affected.
"""

STOPPED = 130


def main() -> None:
    """Run the command line; Ctrl-C ends it with exit code 130, also during imports."""
    # Else a file could get the descriptor of a closed stream, and then what libraries print.
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for name, value in OPENCV_SETTINGS.items():
        os.environ.setdefault(name, value)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="surrogateescape")  # file names may be any bytes
    with noted_interrupts() as interrupts:
        try:
            from .cli import main as command

            code: object = command()
        except SystemExit as error:
            code = error.code
        except BaseException as error:
            if not interrupts:
                raise
            code = error
    if interrupts and code not in (None, 0, STOPPED):
        print("deepdetect: stopped; what was written stays", file=STDERR)
        code = STOPPED
    fails(sys.stderr)  # a full disk would else change the exit code
    sys.exit(code)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
