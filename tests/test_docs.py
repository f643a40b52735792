"""Commands, flags and Python names that the documentation uses exist."""

from __future__ import annotations

import pkgutil
import re
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest

from deepdetect import MissingExtraError
from deepdetect.cli._app import make_app

ROOT = Path(__file__).parents[1]
app = cache(make_app)
OF_THEIR_TIME = ("CHANGELOG.md", "HISTORY.md")
"""Pages with names and options as they were."""

PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("src/**/*.md")]


def code(page: Path) -> list[str]:
    """Return the lines of code blocks, continued ones joined, and what is in backticks."""
    text = page.read_text(encoding="utf-8")
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.S | re.M)
    lines = [line for block in blocks for line in re.sub(r"\\\n", " ", block).splitlines()]
    inline = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M))
    return [*lines, *(" ".join(part.split()) for part in inline)]


@cache
def flags(*words: str) -> set[str]:
    """Return the flags of the command that begins a line of words."""
    command = app()[words[0]]
    for word in words[1:]:
        command = command[word] if word in command else command  # noqa: SIM401
    names = (name for each in command.assemble_argument_collection() for name in each.names)
    return {"--help", "--help-all", *names}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_what_the_page_names_exists(page: Path) -> None:
    if page.name in OF_THEIR_TIME:
        return
    for part in code(page):
        for name, rest in re.findall(r"(?<!from )\bdeepdetect ([a-z][a-z-]+)\b([^#|]*)", part):
            words = re.findall(r"[a-z][a-z-]+", rest.partition("--")[0])[:2]
            assert set(re.findall(r"(?<!\S)--[\w-]+", rest)) <= flags(name, *words)
        names = re.findall(r"(?<![\w/.-])deepdetect(?:\.\w+)+", part)
        if found := re.fullmatch(r"from (deepdetect[\w.]*) import ([\w, ]+)", part):
            names += [f"{found[1]}:{name}" for name in found[2].split(", ")]
        for name in set(names) - {"deepdetect.onnx", "deepdetect.commands"}:
            with suppress(MissingExtraError):  # a drop-in without its program
                pkgutil.resolve_name(re.sub(r"(integrations\.\w+)(\.|$)", r"\1:", name))
