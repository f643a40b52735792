"""The command `deepdetect`: its subcommands, and how errors are reported."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from .. import __version__
from .._shared.errors import (
    BatchError,
    DeepDetectError,
    NoDepthError,
    RegistrationError,
    unknown_name,
)
from ._commands import COMMANDS, NOTHING_FOUND

INTRODUCTION = """\
Usage: deepdetect COMMAND

Dense keypoints from a tiny network, and their matches.

  deepdetect detect photo.jpg            keypoints of an image
  deepdetect match left.jpg right.jpg    matches between two images
  deepdetect reconstruct left.jpg right.jpg --focal 1250    a 3D reconstruction
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return the exit code that the README documents."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help", "--help-all"):
        print(INTRODUCTION)
        for title, commands in COMMANDS.items():
            listed = (f"  {name:<17}{does}" for name, (_, does) in commands.items())
            print(f"{title}:", *listed, "", sep="\n")
        print("`deepdetect COMMAND --help` shows the common options, --help-all shows all.")
        return 0
    if words == ["--version"]:
        print(f"deepdetect {__version__}")
        return 0
    known = [name for group in COMMANDS.values() for name in group]
    if words[0] not in known:
        return _failed(str(unknown_name("command", words[0], known)), 2)
    from .._shared.kernels import announce_compilation
    from .._shared.progress import say
    from ._app import CycloptsError, call, with_flags

    announce_compilation(
        lambda: say("compiling for the first time, about 10 seconds; it is kept for later runs")
    )
    try:
        return call(words)
    except CycloptsError as error:
        return _failed(" ".join(str(error).split()), 2)
    except BatchError as error:
        lines = [f"{error.summary}:", *(f"  {with_flags(each, words)}" for each in error.failures)]
        return _failed("\n".join(lines), 1)
    except DeepDetectError as error:
        nothing_found = isinstance(error, NoDepthError | RegistrationError)
        return _failed(with_flags(str(error), words), NOTHING_FOUND if nothing_found else 2)
    except KeyboardInterrupt:
        return _failed("stopped; what was written stays", 130)
    except BrokenPipeError:
        sys.stderr.close()
        return 1


def _failed(text: str, code: int) -> int:
    print(f"deepdetect: {text}", file=sys.stderr)
    return code
