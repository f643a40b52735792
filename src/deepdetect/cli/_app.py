"""The program `deepdetect`: its commands, their help, and the report of errors."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import os
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from glob import glob
from typing import Annotated, Any, Literal

from cyclopts import (
    App,
    CycloptsError,
    Group,
    MissingArgumentError,
    Parameter,
    UnusedCliTokensError,
)
from cyclopts.help import DefaultFormatter

from .. import __version__
from .._shared.errors import (
    BatchError,
    DeepDetectError,
    MissingExtraError,
    NoDepthError,
    NoPlaceError,
    RegistrationError,
)
from .._shared.progress import STDERR, fails, say

NOTHING_FOUND = 3
"""Exit code of a command that ran without an error but found nothing, such as no matches."""

MORE = Group("More options")
"""The group of options that only --help-all shows."""

INTRODUCTION = """\
Detect and match dense keypoints with a tiny network, and reconstruct scenes in 3D.

`deepdetect COMMAND --help` shows the common options of a command; --help-all shows all options.

    deepdetect detect photo.jpg
    deepdetect match left.jpg right.jpg
    deepdetect reconstruct left.jpg right.jpg --focal 1250
"""

COMMANDS = {
    "Images": {
        "detect": ("detect", "Detect keypoints in images."),
        "match": ("match", "Match the keypoints of two images."),
        "register": ("match", "Register one image to another."),
        "stitch": ("match", "Stitch overlapping images to a panorama."),
        "pose": ("reconstruct", "Estimate the pose of one camera relative to another."),
        "reconstruct": ("reconstruct", "Reconstruct 3D points from two or more images."),
    },
    "Many images": {
        "extract": ("features", "Extract the features of many images."),
        "match-many": ("features", "Match the features of many pairs of images."),
        "track": ("track", "Track points through a video."),
        "export": ("export", "Write files for other programs."),
        "view": ("view", "Show a result in the browser."),
    },
    "DeepDetect itself": {
        "app": ("app", "Serve a page for the browser on this computer."),
        "demo": ("demo", "Match a real stereo pair, and evaluate the matches."),
        "doctor": ("doctor", "Check the installation, and suggest repairs."),
        "completion": ("_app", "Print a script that completes commands and options by Tab."),
    },
}
"""The commands of this package by group: for each, the module of its function, and a summary."""

LAB_ENTRY_POINTS = "deepdetect.commands"
"""Group of the Python entry points by which deepdetect-lab adds commands. Each entry point is a
table like `COMMANDS`, but with full module names; `dev` has the commands `deepdetect dev NAME`."""

LAB_COMMANDS = ("label", "train", "train-descriptor", "dev")
"""Commands of deepdetect-lab. Calling one gives an error if deepdetect-lab is not installed."""

Commands = Mapping[str, Mapping[str, tuple[str, str]]]


class HelpFormatter(DefaultFormatter):
    """Format help as cyclopts does, but only count the `MORE` options unless `shows_all`."""

    shows_all = False

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        if panel.title == MORE.name and not self.shows_all:
            console.print(f"{len(panel.entries)} more options: --help-all")
        else:
            super().__call__(console, options, panel)

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        console.print(description, soft_wrap=True)  # keeps the line breaks of the docstring


FORMATTER = HelpFormatter()


@functools.cache
def make_app(summaries: bool = False) -> App:
    """Return the application, which imports a command's module only when the command is called.

    If `summaries`, the help lists the summaries in `COMMANDS` in place of the docstrings.
    """
    commands, development = _all_commands()
    app = App(
        "deepdetect",
        help=INTRODUCTION,
        help_format="plaintext",
        help_formatter=FORMATTER,
        version=f"deepdetect {__version__}",
        # If an option is repeated, the last value counts.
        default_parameter=Parameter(allow_repeating=True, negative_iterable=()),
    )
    dev = App("dev", help="Develop DeepDetect: benchmarks, data sets, training of its parts.")
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


@functools.cache  # since reading the entry points of all packages takes time
def _all_commands() -> tuple[Commands, Commands]:
    """Return the commands of this package and of deepdetect-lab, and those of `deepdetect dev`."""
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
    """Return the module of the command in a command line, or None if no command is named."""
    name = next((word for word in words if word != "dev"), "")
    commands, development = _all_commands()
    if words[:1] and words[0] in LAB_COMMANDS and not development:
        raise MissingExtraError(
            f"`deepdetect {words[0]}` belongs to deepdetect-lab, which is not installed: run "
            "pip install ./lab in the folder of DeepDetect's sources"
        )
    groups = development if words[:1] == ["dev"] else commands
    return next((group[name][0] for group in groups.values() if name in group), None)


def completion(
    shell: Annotated[
        Literal["bash", "zsh", "fish", "powershell"], Parameter(help="Name of the shell.")
    ],
    /,
) -> None:
    """Print a script that completes commands, options and choices in a shell.

    Save it where the shell looks for completions:

        deepdetect completion bash > ~/.local/share/bash-completion/completions/deepdetect
        deepdetect completion zsh > ~/.zsh/completions/_deepdetect
        deepdetect completion fish > ~/.config/fish/completions/deepdetect.fish
    """
    print(make_app().generate_completion(shell=shell))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit code; docs/commands.md lists the codes."""
    from .._shared.kernels import announce_compilation

    announce_compilation(lambda: say("compiling (first use only, cached): about 10 seconds"))
    words = list(sys.argv[1:] if arguments is None else arguments)
    warn = warnings.showwarning
    say_once = functools.cache(lambda text: say(with_flags(text, words)))

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if category is UserWarning:
            say_once(str(message))
        else:
            warn(message, category, *place, **more)

    try:
        with warnings.catch_warnings():
            warnings.showwarning = show
            return _call(words)
    except CycloptsError as error:
        return _failed(_usage(error), 2)
    except BatchError as error:
        lines = [f"{error.summary}:", *(f"  {with_flags(each, words)}" for each in error.failures)]
        return _failed("\n".join(lines), 1)
    except DeepDetectError as error:
        nothing_found = isinstance(error, NoDepthError | NoPlaceError | RegistrationError)
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
        text = f"cannot write to standard output ({error.strerror}): written files are kept"
        return _failed(text, 2)


def _usage(error: CycloptsError) -> str:
    """Return the error message for a command line that does not fit its command."""
    plain = " ".join(str(error).split())
    if not isinstance(error, MissingArgumentError | UnusedCliTokensError):
        return plain
    chain = error.command_chain or ()
    *_, app = make_app().parse_commands([*chain])[1]
    helps = {
        each.name: f"{each.name} ({(each.parameter.help or '').split('. ')[0].rstrip('.')})"
        for each in app.assemble_argument_collection(parse_docstring=True)
        if each.field_info.is_positional
    }
    command = f"`deepdetect {' '.join(chain)}`"
    if isinstance(error, UnusedCliTokensError):
        known, unused = " and ".join(helps.values()), " ".join(error.unused_tokens or ())
        return f"{command} takes only {known or 'options'}: leave out {unused}"
    if error.argument and error.argument.name in helps:
        return f"{command} needs {helps[error.argument.name]}: its --help shows examples"
    return plain


def _call(words: Sequence[str]) -> int:
    module = _module_of(words)
    if module is not None:
        importlib.import_module(module)  # cyclopts' own import would hide errors
    FORMATTER.shows_all = "--help-all" in words
    meant = {"--help-all": ["--help"], "-": ["/dev/stdin"]}
    # The shell of Windows does not expand patterns such as *.jpg, and no shell does in quotes.
    words = [
        each
        for word in words
        for each in meant.get(word) or (re.search("[*?]", word) and sorted(glob(word))) or [word]
    ]
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
    """In a message of the library, replace the names of parameters by the command's options.

    A word that has an underscore or is in backticks counts as a parameter; `NAME=VALUE` also does.

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
