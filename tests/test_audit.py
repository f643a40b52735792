"""`make audit`: what pip-audit says, in one line where it says nothing."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[1] / "requirements" / "audit.py"


@pytest.fixture(scope="module")
def audit() -> Any:
    spec = importlib.util.spec_from_file_location("audit", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SKIPPED = {"name": "a", "skip_reason": "not found"}
SAFE = {"name": "b", "version": "1", "vulns": []}
FLAWED = {"name": "c", "version": "2", "vulns": [{"id": "PYSEC-1", "fix_versions": ["3"]}]}


@pytest.mark.parametrize(
    ("packages", "told", "known"),
    [
        ([SKIPPED], "no data", False),
        ([SKIPPED, SAFE], "1 of 2 packages looked up, 0 known", False),
        ([SAFE, FLAWED], "2 of 2 packages looked up, 1 known", True),
    ],
)
def test_a_known_vulnerability_fails(audit, packages: list[Any], told: str, known: bool) -> None:
    lines, found = audit.report(json.dumps({"dependencies": packages}))
    assert told in lines[0]
    assert found == known
    assert lines[1:] == (["c 2: PYSEC-1, fixed in 3"] if known else [])
