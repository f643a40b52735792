from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from deepdetect_lab.evaluation.provenance import provenance


def test_versions_and_machine_are_named() -> None:
    found = provenance()
    assert f"numpy {np.__version__}" in found["versions"]
    assert "python 3." in found["versions"]
    assert found["machine"]


def test_the_command_is_told_as_it_would_be_typed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["/opt/bin/deepdetect", "train", "my photos", "-o", "run"])
    assert provenance()["command"] == "deepdetect train 'my photos' -o run"
    monkeypatch.setattr(sys, "argv", ["/src/deepdetect/__main__.py", "train", "a"])
    assert provenance()["command"] == "deepdetect train a"


def test_the_commit_is_that_of_the_sources() -> None:
    commit = provenance()["commit"]
    if not commit:
        pytest.skip("the sources are not in a git repository")
    here = Path(__file__).parent
    head = subprocess.run(
        ["git", "-C", str(here), "rev-parse", "HEAD"], capture_output=True, text=True, check=True
    )
    assert commit.rstrip("+") == head.stdout.strip()
