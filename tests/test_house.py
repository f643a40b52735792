"""What keeps the house small: few options and keywords, and counts that may only fall."""

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

MAX_CORE_LINES = 31_964
"""Lines of Python in src/deepdetect; an issue that brings an ability may raise it, nothing else."""

MAX_FUNCTION_LINES = 120
"""Lines of the longest function, its docstring included."""

MAX_CONSTANTS_PER_1000_LINES = {
    "deepdetect/_shared": 5.6,
    "deepdetect/app": 11.6,
    "deepdetect/batch": 8.8,
    "deepdetect/cli": 3.5,
    "deepdetect/detector": 9.6,
    "deepdetect/features": 14.4,
    "deepdetect/geometry": 16.6,
    "deepdetect/integrations": 8.6,
    "deepdetect/interchange": 3.5,
    "deepdetect/io": 15.1,
    "deepdetect/matching": 22.5,
    "deepdetect/reconstruction": 23.8,
    "deepdetect/sfm": 19.1,
    "deepdetect/tracking": 15.8,
    "deepdetect/viz": 35.4,
    "deepdetect_lab/cli": 0.0,
    "deepdetect_lab/datasets": 8.1,
    "deepdetect_lab/evaluation": 12.6,
    "deepdetect_lab/labels": 14.1,
    "deepdetect_lab/networks": 16.3,
    "deepdetect_lab/training": 28.7,
}
"""Numeric module constants per 1,000 lines of a package: these may only fall."""

MIN_REASONED = {"src/deepdetect": 0.31, "lab/src/deepdetect_lab": 0.41}
"""The share of these constants whose note gives a reason or a measurement: it may only rise."""

REASON = re.compile(
    r"\b(because|since|so that|otherwise|measured|chosen|would|paper|published|as OpenCV|as COLMAP|"
    r"than|on (?:Oxford|HPatches|KITTI|Middlebury|photos)|costs?|takes?|needs?)\b|\d"
)


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


@cache
def trees(package: str) -> dict[Path, tuple[str, ast.Module]]:
    """Return the text and the syntax tree of each file below the folder of a package."""
    texts = {path: path.read_text("utf-8") for path in (ROOT / package).rglob("*.py")}
    return {path: (text, ast.parse(text)) for path, text in texts.items()}


def numeric_constants(tree: ast.Module) -> list[str]:
    """Return the notes under the numeric constants of a module, "" where there is none."""
    notes = []
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not isinstance(node, ast.Assign | ast.AnnAssign) or node.value is None:
            continue
        target = node.targets[0] if isinstance(node, ast.Assign) else node.target
        numbers = [n for n in ast.walk(node.value) if isinstance(n, ast.Constant)]
        if re.fullmatch(r"[(_A-Z0-9, )]+", ast.unparse(target)) and any(
            type(each.value) in (int, float) for each in numbers
        ):
            note = after.value if isinstance(after, ast.Expr) else None
            text = str(note.value) if isinstance(note, ast.Constant) else ""
            notes.append(re.sub(r"Chosen\s+by\s+hand[^.]*\.", "", text))  # which gives no reason
    return notes


def test_the_core_stays_small() -> None:
    assert sum(text.count("\n") for text, _ in trees("src/deepdetect").values()) <= MAX_CORE_LINES


def notes_of(package: str) -> list[str]:
    """Return the notes under all numeric constants of a package."""
    return [note for _, tree in trees(package).values() for note in numeric_constants(tree)]


@pytest.mark.parametrize("distribution", MIN_REASONED)
def test_no_function_is_long(distribution: str) -> None:
    found = {
        f"{path.name}: {node.name}": (node.end_lineno or 0) - node.lineno + 1
        for path, (_, tree) in trees(distribution).items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    }
    assert {n: lines for n, lines in found.items() if lines > MAX_FUNCTION_LINES} == {}


def test_every_package_has_its_ratchet() -> None:
    folders = [path.parent for root in MIN_REASONED for path in (ROOT / root).glob("*/__init__.py")]
    assert {f"{each.parent.name}/{each.name}" for each in folders} == set(
        MAX_CONSTANTS_PER_1000_LINES
    )


@pytest.mark.parametrize("package", MAX_CONSTANTS_PER_1000_LINES)
def test_tuned_numbers_become_fewer(package: str) -> None:
    folder = f"{'lab/src' if package.startswith('deepdetect_lab') else 'src'}/{package}"
    lines = sum(text.count("\n") for text, _ in trees(folder).values())
    assert 1000 * len(notes_of(folder)) / lines <= MAX_CONSTANTS_PER_1000_LINES[package]


@pytest.mark.parametrize("distribution", MIN_REASONED)
def test_tuned_numbers_have_reasons(distribution: str) -> None:
    notes = notes_of(distribution)
    reasoned = sum(REASON.search(note) is not None for note in notes)
    assert reasoned / len(notes) >= MIN_REASONED[distribution]
