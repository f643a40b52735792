"""What the documentation names exists: links, files, commands with their flags, Python names."""

from __future__ import annotations

import pkgutil
import re
from contextlib import suppress
from pathlib import Path

import pytest

from deepdetect import MissingExtraError
from deepdetect.cli._app import make_app

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src/deepdetect"
CARDS = PACKAGE / "detector"
PAGES = {
    str(page.relative_to(ROOT)): page.read_text(encoding="utf-8")
    for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *CARDS.glob("*/*CARD.md"))
}
PRESENT = {
    name: text
    for name, text in PAGES.items()
    if name not in ("CHANGELOG.md", "docs/history.md")  # of names and options as they were
}
FOLDERS = "src|tests|benchmarks|docs|requirements"


def code(text: str) -> list[str]:
    """Return the lines of code blocks, continued ones joined, and what is in backticks."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.S | re.M)
    lines = [line for block in blocks for line in re.sub(r"\\\n", " ", block).splitlines()]
    inline = re.findall(r"`([^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.S | re.M))
    return [*lines, *(" ".join(part.split()) for part in inline)]


@pytest.mark.parametrize("page", PAGES)
def test_links_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", PAGES[page]):
        if not target.startswith(("http:", "https:", "mailto:")):
            path, _, anchor = target.partition("#")
            other = (ROOT / page).parent / path if path else ROOT / page
            assert other.exists(), target
            if anchor and other.suffix == ".md":
                assert anchor in anchors(other.read_text(encoding="utf-8")), target


def anchors(text: str) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", text, re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PRESENT)
def test_paths_exist(page: str) -> None:
    for part in code(PRESENT[page]):
        for path in re.findall(rf"(?<![\w/.:-])(?:{FOLDERS})/[\w./-]+", part):
            assert (ROOT / path).exists(), path


@pytest.mark.parametrize("page", PRESENT)
def test_commands_have_these_flags(page: str) -> None:
    for part in code(PRESENT[page]):
        for name, rest in re.findall(r"(?<!from )\bdeepdetect ([a-z][a-z-]+)\b([^#|]*)", part):
            command = make_app()[name]
            for word in re.findall(r"[a-z][a-z-]+", rest.partition("--")[0])[:2]:
                command = command[word] if word in command else command  # noqa: SIM401
            flags = {flag for each in command.assemble_argument_collection() for flag in each.names}
            assert set(re.findall(r"(?<!\S)--[\w-]+", rest)) <= flags | {"--help", "--help-all"}, (
                name,
                rest,
            )


@pytest.mark.parametrize("page", PRESENT)
def test_python_names_exist(page: str) -> None:
    for part in code(PRESENT[page]):
        for name in re.findall(r"(?<![\w/.-])deepdetect(?:\.\w+)+", part):
            if name != "deepdetect.onnx":
                resolve(re.sub(r"(integrations\.\w+)\.?", r"\1:", name))
        if found := re.fullmatch(r"from (deepdetect[\w.]*) import ([\w, ]+)", part):
            for name in found[2].split(", "):
                resolve(f"{found[1]}:{name}")


def resolve(name: str) -> None:
    with suppress(MissingExtraError):  # a drop-in without its program
        pkgutil.resolve_name(name)


def test_the_index_lists_every_page() -> None:
    pages = {Path(page).name for page in PAGES if page.startswith("docs/")} - {"index.md"}
    assert pages <= set(re.findall(r"\((?:\.\./)?([\w.-]+)\)", PAGES["docs/index.md"]))


@pytest.mark.parametrize("page", PRESENT)
def test_make_targets_exist(page: str) -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z0-9-]+):", makefile, re.M))
    for part in code(PRESENT[page]):
        for target in re.findall(r"^make (?:[A-Z]+=\S+ )?([a-z][a-z0-9-]*)", part):
            assert target in targets


def test_the_map_of_the_house_is_complete() -> None:
    rows = re.findall(r"^\| `(\w+)` \|", PAGES["CONTRIBUTING.md"], re.M)
    assert sorted(rows) == sorted(path.parent.name for path in PACKAGE.glob("*/__init__.py"))
