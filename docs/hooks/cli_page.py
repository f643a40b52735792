"""The page of the command line, made from the commands themselves."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator

import click

INTRODUCTION = """\
# Command line

Made from the commands: it says what `deepdetect COMMAND --help` says. How results are written,
when a command goes on where it stopped, and what the exit codes mean is in the
[README](../README.md#use).

`-h` or `--help` helps with each command, `--version` prints the version.

| command | what it does |
|---|---|
"""

COMPLETION = """
## Completion by Tab

The shell completes commands and options when it is told how, once. Bash (4.4 or later), in
`~/.bashrc`:

```sh
eval "$(_DEEPDETECT_COMPLETE=bash_source deepdetect)"
```

Zsh, in `~/.zshrc`:

```sh
eval "$(_DEEPDETECT_COMPLETE=zsh_source deepdetect)"
```

Fish, in `~/.config/fish/completions/deepdetect.fish`:

```sh
_DEEPDETECT_COMPLETE=fish_source deepdetect | source
```

Each new shell then starts `deepdetect` once. To spare that, write what it prints to a file, and
`source` the file instead; make it again after an update:

```sh
_DEEPDETECT_COMPLETE=bash_source deepdetect > ~/.deepdetect-completion.bash
```
"""


def make_page() -> str:
    """Return the page in Markdown."""
    from deepdetect.cli import main

    commands = list(_walk(main, "deepdetect"))
    table = "".join(
        f"| [`{name}`](#{_anchor(name)}) | {command.get_short_help_str(200)} |\n"
        for name, command in commands
    )
    return (
        INTRODUCTION
        + table
        + "".join(_section(name, command) for name, command in commands)
        + COMPLETION
    )


def _walk(group: click.Group, name: str) -> Iterator[tuple[str, click.Command]]:
    """Yield all commands that can be run, with their whole names."""
    for word, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from _walk(command, f"{name} {word}")
        else:
            yield f"{name} {word}", command


def _anchor(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _section(name: str, command: click.Command) -> str:
    context = click.Context(command, info_name=name, max_content_width=100)
    parameters = command.get_params(context)
    usage = " ".join([name, *command.collect_usage_pieces(context)])
    lines = [f"\n## {name}\n", f"```text\n{usage}\n```\n", _help(command)]
    rows = [
        record
        for parameter in parameters
        if isinstance(parameter, click.Option) and "--help" not in parameter.opts
        if (record := parameter.get_help_record(context)) is not None
    ]
    if rows:
        lines.append("| option | what it does |\n|---|---|")
        lines += [f"| `{_cell(flags)}` | {_cell(_text(text))} |" for flags, text in rows]
    return "\n".join(lines) + "\n"


def _help(command: click.Command) -> str:
    """Return a command's help; paragraphs that click does not wrap are code."""
    parts = []
    for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
        if paragraph.startswith("\b\n"):
            parts.append("```sh\n" + paragraph.removeprefix("\b\n") + "\n```")
        else:
            parts.append(_text(paragraph))
    return "\n\n".join(parts) + "\n"


def _text(text: str) -> str:
    """Return plain text as Markdown: outside of code, underscores and stars mean themselves."""
    parts = re.split(r"(`[^`]+`)", text)
    parts[::2] = [re.sub(r"([*_<\[])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
