"""The new names of the changelog's tables exist."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import re
import typing
from pathlib import Path

import click
import pytest

import deepdetect
from deepdetect.cli import main
from deepdetect.geometry.relative_pose import RelativePose

CHANGELOG = (Path(__file__).parents[1] / "CHANGELOG.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in CHANGELOG.partition("### Old and new names")[2].partition("\n## ")[0].splitlines()
    if line.startswith("| ") and ", old |" not in line
]
NEW = sorted({name for row in ROWS for name in re.findall(r"`([^`]+)`", row[-1])})


def option_classes() -> dict[str, type]:
    """Return the dataclasses of the public API, and those of their fields, by name."""
    roots = [getattr(deepdetect, name) for name in deepdetect.__all__]
    device = importlib.import_module("deepdetect.training").DeviceOptions
    classes: dict[str, type] = {}
    waiting = [*filter(dataclasses.is_dataclass, roots), RelativePose, device]
    while waiting:
        kind = waiting.pop()
        if dataclasses.is_dataclass(kind) and kind.__name__ not in classes:
            classes[kind.__name__] = kind
            for hint in typing.get_type_hints(kind).values():
                waiting += [hint, *typing.get_args(hint)]
    return classes


def test_the_tables_are_read() -> None:
    assert len(ROWS) > 80
    assert all(len(row) == 2 for row in ROWS)


@pytest.mark.parametrize("name", [n for n in NEW if n.startswith("deepdetect.")])
def test_modules_exist(name: str) -> None:
    module, _, attribute = name.rpartition(".")
    try:
        importlib.import_module(name)
    except ModuleNotFoundError:
        assert hasattr(importlib.import_module(module), attribute)


@pytest.mark.parametrize("name", [n for n in NEW if re.match(r"[A-Z][A-Za-z]+\.\w+", n)])
def test_fields_exist(name: str) -> None:
    kind, field = re.findall(r"\w+", name)[:2]
    chosen = option_classes()[kind]
    fields = {field.name for field in dataclasses.fields(chosen)}
    assert field in fields or hasattr(chosen, field)


@pytest.mark.parametrize("name", [n for n in NEW if re.match(r"\w+\(\w+=", n)])
def test_parameters_exist(name: str) -> None:
    function, parameter = re.findall(r"\w+", name)[:2]
    assert parameter in inspect.signature(getattr(deepdetect, function)).parameters


@pytest.mark.parametrize("name", [n for n in NEW if n.startswith("deepdetect ")])
def test_flags_exist(name: str) -> None:
    command = main.commands[name.split()[1]]
    options = command.get_params(click.Context(command))
    flags = {flag for option in options for flag in (*option.opts, *option.secondary_opts)}
    assert set(re.findall(r"--[\w-]+", name)) <= flags
