"""The command `deepdetect`: its subcommands, their help, and how errors are reported."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal

from cyclopts import App, CycloptsError, Group, Parameter
from cyclopts.help import DefaultFormatter

from .. import __version__
from .._shared.errors import (
    BatchError,
    DeepDetectError,
    MissingExtraError,
    NoDepthError,
    RegistrationError,
)
from .._shared.progress import STDERR, fails, say

NOTHING_FOUND = 3
"""Exit code where all went well and nothing was found."""

MORE = Group("More options")
"""Shown by --help-all."""

INTRODUCTION = """\
Dense keypoints from a tiny network, and their matches.

`deepdetect COMMAND --help` shows the common options of a command, --help-all shows all.

    deepdetect detect photo.jpg
    deepdetect match left.jpg right.jpg
    deepdetect reconstruct left.jpg right.jpg --focal 1250
"""

COMMANDS = {
    "Images": {
        "detect": ("detect", "keypoints of images"),
        "match": ("match", "matches between two images"),
        "register": ("match", "one image registered to another"),
        "stitch": ("match", "a panorama of overlapping images"),
        "pose": ("reconstruct", "the pose of one camera relative to another"),
        "reconstruct": ("reconstruct", "a 3D reconstruction of two images, or of many"),
    },
    "Many images": {
        "extract": ("features", "features of a collection of images"),
        "match-many": ("features", "matches of many pairs of images"),
        "track": ("track", "points followed through a video"),
        "export": ("export", "files for other programs"),
        "view": ("view", "a result in the browser"),
    },
    "DeepDetect itself": {
        "app": ("app", "a page in the browser, on this computer"),
        "demo": ("demo", "match a real stereo pair, and evaluate the matches"),
        "doctor": ("doctor", "check the installation, and say what to do about it"),
        "completion": ("_app", "completion of commands and options by Tab"),
    },
}
"""The commands of this package by their group: the function's module, and what it does."""

LAB_ENTRY_POINTS = "deepdetect.commands"
"""The group of entry points by which deepdetect-lab adds commands: tables such as `COMMANDS`.

One named `dev` holds those after the word `dev`. Their modules are named in full.
"""

LAB_COMMANDS = ("label", "train", "train-descriptor", "dev")
"""The names that deepdetect-lab adds, for the sentence that says where it is missing."""

Commands = Mapping[str, Mapping[str, tuple[str, str]]]


class HelpFormatter(DefaultFormatter):
    """Help of cyclopts; of the group `MORE` the number, unless all options are asked for."""

    shows_all = False

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        if panel.title == MORE.name and not self.shows_all:
            console.print(f"{len(panel.entries)} more options: --help-all")
        else:
            super().__call__(console, options, panel)

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        console.print(description, soft_wrap=True)  # in the lines of the docstring


FORMATTER = HelpFormatter()


@functools.cache
def make_app(summaries: bool = False) -> App:
    """Return the application, whose commands are imported when they are called.

    With summaries it lists them without; else each says itself what it does.
    """
    commands, development = _all_commands()
    app = App(
        "deepdetect",
        help=INTRODUCTION,
        help_format="plaintext",
        help_formatter=FORMATTER,
        version=f"deepdetect {__version__}",
        # Of an option that is repeated the last one counts.
        default_parameter=Parameter(allow_repeating=True, negative_iterable=()),
    )
    dev = App("dev", help="Benchmarks, data sets, and what else makes DeepDetect itself.")
    for parent, groups in ((app, commands), (dev, development)):
        for title, members in groups.items():
            group = Group.create_ordered(title)
            for number, (name, (module, does)) in enumerate(members.items()):
                path = f"{module}:{name.replace('-', '_')}"
                shown: dict[str, Any] = {"help": does, "group": group, "sort_key": number}
                parent.command(path, name=name, **(shown if summaries else {}))
    if development:
        dev.group = Group.create_ordered("Development")
        app.command(dev)
    return app


def _all_commands() -> tuple[Commands, Commands]:
    """Return the commands of this package and of deepdetect-lab, and those after `dev`."""
    commands = {
        title: {name: (f"{__package__}.{module}", does) for name, (module, does) in group.items()}
        for title, group in COMMANDS.items()
    }
    added = {p.name: p.load() for p in importlib.metadata.entry_points(group=LAB_ENTRY_POINTS)}
    development = added.pop("dev", {})
    for table in added.values():
        commands |= table
    return commands, development


def _module_of(words: Sequence[str]) -> str | None:
    """Return the module of the command that is called, if any.

    Entry points are only read where it is no command of this package: that takes time.
    """
    name = next((word for word in words if word != "dev"), "")
    if words[:1] != ["dev"]:
        own = (group[name][0] for group in COMMANDS.values() if name in group)
        if module := next(own, None):
            return f"{__package__}.{module}"
    commands, development = _all_commands()
    if words[:1] and words[0] in LAB_COMMANDS and not development:
        raise MissingExtraError(
            f"`deepdetect {words[0]}` belongs to deepdetect-lab, which is not installed: run "
            "pip install ./lab in the folder of the sources"
        )
    groups = development if words[:1] == ["dev"] else commands
    return next((group[name][0] for group in groups.values() if name in group), None)


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish", "powershell"], Parameter(help="Name of the shell.")
    ],
    /,
) -> None:
    """Print what makes a shell complete commands, options and choices.

    deepdetect completion bash > ~/.local/share/bash-completion/completions/deepdetect
    deepdetect completion zsh > ~/.zsh/completions/_deepdetect
    deepdetect completion fish > ~/.config/fish/completions/deepdetect.fish
    """
    print(make_app().generate_completion(shell=shell))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command, and return the exit code that docs/commands.md documents."""
    from .._shared.kernels import announce_compilation

    announce_compilation(
        lambda: say("compiling what this needs for the first time, about 10 seconds; it is kept")
    )
    words = list(sys.argv[1:] if arguments is None else arguments)
    warn = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if category is UserWarning:
            say(with_flags(str(message), words))
        else:
            warn(message, category, *place, **more)

    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            return _call(words)
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
    except OSError as error:
        if not fails(sys.stdout):
            if error.filename is None:
                raise
            name = os.fsdecode(error.filename)
            return _failed(f"{name} cannot be used ({error.strerror}): check the path", 2)
        if isinstance(error, BrokenPipeError):
            return 1
        text = f"cannot write to standard output ({error.strerror}): what is in files stays"
        return _failed(text, 2)


def _call(words: Sequence[str]) -> int:
    module = _module_of(words)
    if module is not None:
        importlib.import_module(module)  # with its own errors
    FORMATTER.shows_all = "--help-all" in words
    meant = {"--help-all": "--help", "-": "/dev/stdin"}
    words = [meant.get(word, word) for word in words]
    app = make_app(summaries=module is None)
    command, bound, _ = app.parse_args(words, print_error=False, exit_on_error=False)
    code = command(*bound.args, **bound.kwargs) or 0
    if sys.stdout is not None:
        sys.stdout.flush()
    return code


def _failed(text: str, code: int) -> int:
    print(f"deepdetect: {text}", file=STDERR)
    return code


def with_flags(message: str, words: Sequence[str]) -> str:
    """Name a command's options where a message of the library names parameters.

    These are words with an underscore, or words between backticks, alone or with a value.

    Example:
        >>> with_flags("set nms_radius, or `pictures=False`", ["detect"])
        'set --nms-radius, or --no-pictures'
    """
    _, apps, _ = make_app().parse_commands(list(words))
    arguments = apps[-1].assemble_argument_collection() if len(apps) > 1 else ()
    options = {each.field_info.name: each for each in arguments if each.field_info.is_keyword}

    def flag(match: re.Match[str]) -> str:
        option, value = options.get(match[1] or match[3]), match[2]
        if option is None:
            return match[0].strip("`")
        if value in ("True", "False"):
            return (option.positives if value == "True" else option.negatives)[0]
        return option.name if value is None else f"{option.name} {value.strip(chr(34))}"

    quoted = r"`(\w+)(?:=([^`]+))?`"
    bare = r"(?<![\w./\\\"'-])([a-z0-9]+(?:_[a-z0-9]+)+)(?![\w./\\\"'-])"
    return re.sub(f"{quoted}|{bare}", flag, message)
