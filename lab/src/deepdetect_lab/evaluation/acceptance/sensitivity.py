"""Measure how much the answers of guided matching depend on each of its numeric constants."""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from deepdetect._shared.progress import progress

from ..report import Row, Rows, Table
from .measure import guided, measure

MODULES = (
    *(f"deepdetect.matching.guided.{name}" for name in ("along_plane", "along_rows", "cells")),
    *(f"deepdetect.matching.guided.{name}" for name in ("explanation", "judge", "proposals")),
    "deepdetect.matching.guided.simulated_views",
    "deepdetect.geometry.two_view",
)
"""The modules of guided matching whose numeric constants are changed."""

FACTORS = 0.7, 1.4
"""Each constant is multiplied by each factor, while all other constants keep their values. Chosen
by hand."""

COLUMNS = {
    **{"constant": "", "module": "", "value": "", "factor": ".1f", "answers": ",d"},
    **{"changed": ".1%", "right before": ",d", "right": ",d", "wrong, high": ",d"},
}

NOTE = (
    "An answer has changed if its verdict (right, wrong or lost), model or confidence differs from "
    "that with the unchanged constant. One seed is used."
)

Value = float | tuple[float, ...]


def constants(module: ModuleType) -> dict[str, Value]:
    """Return the numeric constants that a module defines, by name.

    A constant is named in capitals, and is a number or a tuple of numbers.
    """
    tree = ast.parse(inspect.getsource(module))
    targets = [
        target for node in tree.body if isinstance(node, ast.Assign) for target in node.targets
    ]
    names = [
        name.id for target in targets for name in ast.walk(target) if isinstance(name, ast.Name)
    ]
    values = {name: vars(module)[name] for name in names if name.isupper()}
    return {name: value for name, value in values.items() if _is_numeric(value)}


def _is_numeric(value: object) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(_is_numeric(each) for each in value)
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def scaled(value: Value, factor: float) -> Value:
    """Multiply a constant; whole numbers stay whole and change by at least 1."""
    if isinstance(value, tuple):
        return tuple(scaled(each, factor) for each in value)  # type: ignore[misc]
    if not isinstance(value, int):
        return value * factor
    other = round(value * factor)
    return max(other, value + 1) if factor > 1 else min(other, value - 1)


@contextmanager
def changed(name: str, module: ModuleType, value: Value) -> Iterator[None]:
    """Give a constant another value within a `with` block, also in modules that import it."""
    before = vars(module)[name]
    users = [
        each
        for key, each in list(sys.modules.items())
        if key.startswith("deepdetect.") and vars(each).get(name) is before
    ]
    for each in users:
        setattr(each, name, value)
    try:
        yield
    finally:
        for each in users:
            setattr(each, name, before)


def sensitivity(
    data: Path,
    folder: Path,
    *,
    families: Sequence[str],
    every: int = 1,
    quiet: bool = True,
) -> Rows:
    """Match pairs with each constant changed; return a row for each constant and factor.

    Answers are kept in the folder, a file for each change, so that a second call only computes the
    missing answers.

    Args:
        data: folder of the data sets.
        folder: folder of the answers.
        families: names of families of pairs.
        every: answer only every Nth pair of a family.
        quiet: show no progress bar.
    """
    how: dict[str, Any] = {"families": families, "seeds": 1, "every": every}
    engine, rows = guided(), []
    before = measure(data, engine, folder / "unchanged.jsonl", **how)
    tried = [
        (module, name, value, factor)
        for module in map(import_module, MODULES)
        for name, value in constants(module).items()
        for factor in FACTORS
    ]
    with progress(len(tried), "constants", "change", quiet=quiet) as bar:
        for module, name, value, factor in tried:
            short = module.__name__.rpartition(".")[2]
            log = folder / f"{short}.{name}.{factor}.jsonl"
            with changed(name, module, scaled(value, factor)):
                after = measure(data, engine, log, **how)
            told = {"constant": name, "module": short, "value": str(value), "factor": factor}
            rows.append(told | _compared(before, after))
            bar.update(1)
    return rows


def _compared(before: Rows, after: Rows) -> Row:
    kinds = "answer", "model", "confidence"
    known = {(each["kind"], each["pair"]): each for each in before}
    differ = [
        any(each[kind] != known[each["kind"], each["pair"]][kind] for kind in kinds)
        for each in after
    ]
    right = [sum(each["answer"] == "right" for each in rows) for rows in (before, after)]
    high = sum(each["answer"] == "wrong" and each["confidence"] == "high" for each in after)
    return {
        **{"answers": len(after), "changed": sum(differ) / max(len(differ), 1)},
        **{"right before": right[0], "right": right[1], "wrong, high": high},
    }


def table(rows: Rows) -> Table:
    """Return a table of the rows, sorted by the fraction of changed answers, the largest first."""
    ordered = sorted(rows, key=lambda row: -row["changed"])
    return Table("sensitivity", "Constants of guided matching", COLUMNS, ordered, NOTE)
