"""Phrases that must be read twice are found, and there are none in what users read."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("words", ROOT / "tools/plain_english.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    "text",
    [
        "It was fast. Of the points half are right.",
        "| seed | Of all choices. |",
        "Weights of free licences.",
        "The score is .88.",
        "Process each frame with a number that this divides.",
    ],
)
def test_phrases_are_found(script: ModuleType, text: str) -> None:
    assert len(script.problems("page", f"First line.\n{text}")) == 1
    assert script.problems("page", f"First line.\n{text}")[0].startswith("page:2: ")


@pytest.mark.parametrize("text", ["Of course.", "`.88`", "```\nx = .5, too.\n```", "v1.25", "0.88"])
def test_code_and_plain_words_pass(script: ModuleType, text: str) -> None:
    assert script.problems("page", text) == []


def test_what_users_read_is_plain(script: ModuleType) -> None:
    assert {"README.md", "points.md", "--help-all"} <= set(script.texts())
    assert [
        line for name, text in script.texts().items() for line in script.problems(name, text)
    ] == []
