"""What keeps the interface small: few options, each set somewhere, and few keywords a function."""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import pytest

import deepdetect

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src/deepdetect"
MAX_OPTION_CLASSES = 30
MAX_KEYWORDS = 12
MAX_ROOT_NAMES = 32


@cache
def option_classes() -> dict[str, type]:
    """Return the dataclasses of options, by their names."""
    found = {}
    for path in SOURCE.rglob("*.py"):
        for node in ast.parse(path.read_text("utf-8")).body:
            if isinstance(node, ast.ClassDef) and re.search("(Options|Settings)$", node.name):
                name = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
                found[node.name] = getattr(importlib.import_module(name), node.name)
    return {name: kind for name, kind in found.items() if dataclasses.is_dataclass(kind)}


@cache
def text_beside(kind: type) -> str:
    """Return all code and documentation but tests and the class itself."""
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("docs/notebooks/*.ipynb")]
    folders = (SOURCE, ROOT / "benchmarks", ROOT / "examples", ROOT / "fuzz")
    files = [path for folder in folders for path in folder.rglob("*.py")]
    text = "\n".join(path.read_text("utf-8") for path in (*files, *pages))
    return text.replace(inspect.getsource(kind), "")


def depth(kind: type) -> int:
    """Return how many levels of options lie in a class of options, itself included."""
    hints = " ".join(str(each.type) for each in dataclasses.fields(kind))
    inner = [other for name, other in option_classes().items() if re.search(rf"\b{name}\b", hints)]
    return 1 + max(map(depth, inner), default=0)


def test_option_classes_are_few() -> None:
    assert 10 < len(option_classes()) <= MAX_OPTION_CLASSES


@pytest.mark.parametrize("name", sorted(option_classes()))
def test_every_option_is_set_somewhere(name: str) -> None:
    kind = option_classes()[name]
    assert depth(kind) <= 2
    text = text_beside(kind)
    if f"From({name}" in text:  # all fields are options of a command
        return
    for each in dataclasses.fields(kind):
        flag = "--" + each.name.replace("_", "-")
        assert re.search(rf"\b{each.name}\s*=[^=]|\"{each.name}\"|{flag}\b", text), each.name


def public_functions() -> list[object]:
    found: list[object] = []
    for name in deepdetect.__all__:
        thing = getattr(deepdetect, name)
        if inspect.isfunction(thing):
            found.append(thing)
        elif inspect.isclass(thing) and not (
            dataclasses.is_dataclass(thing) or issubclass(thing, Exception)
        ):
            members = vars(thing).items()
            found += [f for n, f in members if inspect.isfunction(f) and not n.startswith("__")]
            found.append(thing)
    return found


@pytest.mark.parametrize("function", public_functions(), ids=lambda f: f.__qualname__)
def test_keywords_are_few(function: object) -> None:
    parameters = inspect.signature(function).parameters.values()
    optional = [p for p in parameters if p.default is not p.empty]
    assert len(optional) <= MAX_KEYWORDS


def test_the_root_exports_what_inference_needs() -> None:
    assert len(set(deepdetect.__all__) - {"__version__"}) <= MAX_ROOT_NAMES
