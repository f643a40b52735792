"""The commands as an application of cyclopts, and how their help is shown."""

from __future__ import annotations

import functools
import importlib
import re
import textwrap
from collections.abc import Sequence
from itertools import zip_longest
from typing import Annotated, Any, Literal

from cyclopts import App, CycloptsError, Parameter
from cyclopts.help import PlainFormatter

from ._commands import COMMANDS
from ._options import MORE

__all__ = ["CycloptsError", "call", "make_app", "with_flags"]


class HelpFormatter(PlainFormatter):
    """Help in two columns; the group `MORE` only when all options are asked for."""

    shows_all = False

    def __call__(self, console: Any, options: Any, panel: Any) -> None:
        if panel.title == MORE.name and not self.shows_all:
            self._print_plain(console, f"{len(panel.entries)} more options: --help-all")
        else:
            super().__call__(console, options, panel)

    def render_description(self, console: Any, options: Any, description: Any) -> None:
        console.width = 110
        super().render_description(console, options, description)

    def _print_plain(self, console: Any, text: str) -> None:
        print(text)  # as wide as it is, wherever it goes

    def _format_parameter_entry(
        self, options: tuple[str, ...], desc: str, console: Any, entry: Any
    ) -> None:
        # Of several names the first and the short one.
        names = [*entry.positive_shorts, *entry.positive_names[:1], *entry.negative_names]
        value = (entry.metavar or "").replace("CHOICE", "|".join(entry.choices or ()))
        label = f"{', '.join(names)} {value}" if names else entry.display_labels[0]
        default = {"True": "yes", "False": None}.get(entry.default, entry.default)
        shown = f"  [default: {default}]" if default is not None and "[default:" not in desc else ""
        self._format_command_entry((label.strip(),), (), f"{desc}{shown}", console)

    def _format_command_entry(
        self, names: tuple[str, ...], shorts: tuple[str, ...], desc: str, console: Any
    ) -> None:
        lines = textwrap.wrap(" ".join(desc.split()).replace(" [", "  ["), 70) or [""]
        lines = lines if len(names[0]) <= 26 else ["", *lines]
        print(
            "\n".join(
                f"  {a:<27} {b}".rstrip() for a, b in zip_longest(names[:1], lines, fillvalue="")
            )
        )


FORMATTER = HelpFormatter()


@functools.cache
def make_app() -> App:
    """Return the application; a command is imported when it is called."""
    last_wins = Parameter(allow_repeating=True)
    app = App(
        "deepdetect",
        help_format="plaintext",
        help_formatter=FORMATTER,
        version_flags=(),
        default_parameter=last_wins,
    )
    app["--help"].group = ()
    for group in COMMANDS.values():
        for name, (module, _) in group.items():
            app.command(f"{__package__}.{module}:{name.replace('-', '_')}", name=name)
    return app


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


def call(words: Sequence[str]) -> int:
    """Run a command, and return its exit code.

    Raises:
        CycloptsError: the command or an option is unknown, or a value cannot be read.
    """
    (module,) = (group[words[0]][0] for group in COMMANDS.values() if words[0] in group)
    importlib.import_module(f".{module}", __package__)  # with its own errors
    FORMATTER.shows_all = "--help-all" in words
    words = ["--help" if word == "--help-all" else word for word in words]
    command, bound, _ = make_app().parse_args(words, print_error=False, exit_on_error=False)
    return command(*bound.args, **bound.kwargs) or 0


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
