"""The shipped products are those that the script makes."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

from deepdetect.features.matchers import PRODUCTS

pytest.importorskip("onnx", reason="needs onnx, which is for exporting only")


def test_the_files_are_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = Path(__file__).parents[2] / "tools/product_graphs.py"
    monkeypatch.setattr(sys, "argv", [str(script), str(tmp_path)])
    runpy.run_path(str(script), run_name="__main__")
    made, shipped = (
        {path.name: path.read_bytes() for path in folder.iterdir()}
        for folder in (tmp_path, PRODUCTS)
    )
    assert made == shipped
