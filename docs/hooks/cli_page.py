"""The page of the command line, made from the commands themselves."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

INTRODUCTION = """\
# Command line

Made from the commands: it says what `deepdetect COMMAND --help-all` says. How results are written,
when a command continues where it stopped, and what the exit codes mean: [commands](commands.md).

`-h` or `--help` shows the common options of a command, `--help-all` shows all, `--version` prints
the version.

| command | what it does |
|---|---|
"""


def make_page() -> str:
    """Return the page in Markdown."""
    commands = dict(walk())
    table = "".join(
        f"| [`{name}`](#{_anchor(name)}) | {_text(_help(app).partition(chr(10))[0])} |\n"
        for name, app in commands.items()
    )
    return INTRODUCTION + table + "".join(_section(*each) for each in commands.items())


def walk() -> Iterator[tuple[str, Any]]:
    """Yield all commands that can be run, with their whole names."""
    from deepdetect.cli._app import make_app

    yield from _within("deepdetect", make_app())


def _within(name: str, app: Any) -> Iterator[tuple[str, Any]]:
    parts = [part for part in app if not part.startswith("-")]
    for part in parts:
        yield from _within(f"{name} {part}", app[part])
    if not parts:
        yield name, app


def _help(app: Any) -> str:
    """Return what a command says of itself, without its arguments."""
    doc = inspect.getdoc(app.default_command) or ""
    return doc.partition("\nArgs:\n")[0].strip()


def _anchor(heading: str) -> str:
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def _section(name: str, app: Any) -> str:
    arguments = [
        each for each in app.assemble_argument_collection(parse_docstring=True) if each.show
    ]
    usage = [name, *(each.name for each in arguments if not each.name.startswith("-"))]
    lines = [f"\n## {name}\n", f"```text\n{' '.join(usage)} [OPTIONS]\n```\n"]
    for paragraph in _help(app).split("\n\n"):
        code = paragraph.startswith("    ")
        lines.append(f"```sh\n{inspect.cleandoc(paragraph)}\n```\n" if code else _text(paragraph))
        lines.append("")
    lines.append("| option | what it does |\n|---|---|")
    for each in arguments:
        shown = f"  [default: {each.field_info.default}]" if _has_default(each) else ""
        lines.append(f"| `{', '.join(each.names)}` | {_text(each.parameter.help + shown)} |")
    return "\n".join(lines) + "\n"


def _has_default(argument: Any) -> bool:
    default = argument.field_info.default
    return isinstance(default, (str, int, float)) and "[default:" not in argument.parameter.help


def _text(text: str) -> str:
    """Return plain text as Markdown: outside of code, underscores and stars mean themselves."""
    parts = re.split(r"(`[^`]+`)", " ".join(text.split()))
    parts[::2] = [re.sub(r"([*_<\[|])", r"\\\1", part) for part in parts[::2]]
    return "".join(parts)
