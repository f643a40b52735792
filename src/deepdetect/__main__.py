"""Entry point of `python -m deepdetect` and of the command `deepdetect`."""

from __future__ import annotations

import io
import os
import sys

from ._shared.progress import STDERR, fails
from ._shared.signals import noted_interrupts

OPENCV_SETTINGS = {"OPENCV_LOG_LEVEL": "SILENT", "OPENCV_FFMPEG_LOGLEVEL": "-8"}
"""Environment variables that keep OpenCV and its FFmpeg from printing beside our error messages.

OpenCV reads them when it is loaded. A user's own setting stays, and programs that import this
package are not affected.
"""

STOPPED = 130


def main() -> None:
    """Run the command line; Ctrl-C ends it with exit code 130, even during imports."""
    # A closed standard stream is opened as the null device. Otherwise a file could get its number,
    # and what libraries print would be written into that file.
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(number)
    for name, value in OPENCV_SETTINGS.items():
        os.environ.setdefault(name, value)
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="surrogateescape")  # file names may contain any bytes
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
    fails(sys.stderr)  # otherwise a full disk changes the exit code
    sys.exit(code)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
