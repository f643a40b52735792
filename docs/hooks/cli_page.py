"""The page of the command line, generated from the commands."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Iterator
from typing import Any

INTRODUCTION = """\
# Command line

This page is generated from the commands and contains the same as `deepdetect COMMAND --help-all`.
[Commands](commands.md) explains how results are written, when a command continues where it stopped,
and what the exit codes mean.

`-h` or `--help` shows the common options of a command, `--help-all` shows all, `--version` prints
the version.

## Shared options

Many commands have these options. Each command below lists those that it has.

"""

TABLE_HEAD = "| option | what it does |\n|---|---|\n"

SHARED_BY = 4
"""Options with the same text in at least this many commands are explained once. Chosen by hand."""


def make_page() -> str:
    """Return the page in Markdown."""
    commands = dict(walk())
    tables = {name: _options(app) for name, app in commands.items()}
    uses = Counter(option for table in tables.values() for option in table.items())
    shared = {
        flags: text
        for (flags, text), times in uses.items()
        if times >= SHARED_BY and flags.startswith("-")
    }
    sections = (_section(name, app, tables[name], shared) for name, app in commands.items())
    return f"{INTRODUCTION}{_table(shared)}{''.join(sections)}"


def walk() -> Iterator[tuple[str, Any]]:
    """Yield all commands that can be run, with their full names."""
    from deepdetect.cli._app import make_app

    yield from _within("deepdetect", make_app())


def _within(name: str, app: Any) -> Iterator[tuple[str, Any]]:
    parts = [part for part in app if not part.startswith("-")]
    for part in parts:
        yield from _within(f"{name} {part}", app[part])
    if not parts:
        yield name, app


def _help(app: Any) -> str:
    """Return the description of a command, without its arguments."""
    doc = inspect.getdoc(app.default_command) or ""
    return doc.partition("\nArgs:\n")[0].strip()


def _arguments(app: Any) -> list[Any]:
    return [each for each in app.assemble_argument_collection(parse_docstring=True) if each.show]


def _options(app: Any) -> dict[str, str]:
    """Return the help of each argument of a command, by its names."""
    options = {}
    for each in _arguments(app):
        shown = f"  [default: {each.field_info.default}]" if _has_default(each) else ""
        options[", ".join(each.names)] = _text(each.parameter.help + shown)
    return options


def _table(options: dict[str, str]) -> str:
    return TABLE_HEAD + "".join(f"| `{flags}` | {text} |\n" for flags, text in options.items())


def _section(name: str, app: Any, options: dict[str, str], shared: dict[str, str]) -> str:
    positional = [each.name for each in _arguments(app) if not each.name.startswith("-")]
    lines = [f"\n## {name}\n", f"```text\n{' '.join([name, *positional])} [OPTIONS]\n```\n"]
    for paragraph in _help(app).split("\n\n"):
        code = paragraph.startswith("    ")
        lines.append(f"```sh\n{inspect.cleandoc(paragraph)}\n```\n" if code else _text(paragraph))
        lines.append("")
    own = {flags: text for flags, text in options.items() if shared.get(flags) != text}
    others = [f"`{flags.partition(',')[0]}`" for flags in options if flags not in own]
    if own:
        lines.append(_table(own))
    if others:
        lines.append(f"[Shared options](#shared-options): {', '.join(others)}\n")
    return "\n".join(lines)


def _has_default(argument: Any) -> bool:
    default = argument.field_info.default
    if default is False:  # switches are off by default
        return False
    return isinstance(default, (str, int, float)) and "[default:" not in argument.parameter.help


def _text(text: str) -> str:
    """Convert plain text to Markdown: escape special characters outside of code."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    parts[::2] = [re.sub(r"([*_<\[|])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
