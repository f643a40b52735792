"""`python -m deepdetect` and the command `deepdetect`."""

from __future__ import annotations

import signal
import sys
from types import FrameType


def main() -> None:
    """Run the command line; Ctrl-C ends it with exit code 130, while packages are imported, too."""
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True
        raise KeyboardInterrupt

    # Packages that are interrupted while they are imported raise what they like.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, stop)
    try:
        from .cli import main as command

        command(prog_name="deepdetect")
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
