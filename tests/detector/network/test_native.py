from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from deepdetect.detector.network.native import native_library


@pytest.fixture(autouse=True)
def _afresh() -> None:
    native_library.cache_clear()
    yield
    native_library.cache_clear()


def test_a_library_has_the_functions_of_its_source() -> None:
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    library = native_library("norm_activation")
    assert library.forward
    assert library.backward
    assert native_library("norm_activation") is library, "compiled once"


def test_without_a_compiler_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert native_library("norm_activation") is None


def test_with_a_compiler_that_fails_there_is_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    broken = tmp_path / "g++"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert native_library("norm_activation") is None
