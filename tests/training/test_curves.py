from __future__ import annotations

import csv
import sys
from pathlib import Path

import pytest
from PIL import Image

from deepdetect.training.curves import CurvePoint, save_curves

POINTS = [
    CurvePoint(10, 1.0, 40, 1e-3, 0.5, 0.45, 0.4, 0.6, 0.6, 0.3),
    CurvePoint(20, 2.0, 80, 1e-6, 0.3, 0.25, 0.2, 0.8, 0.4, 0.5),
]


def test_csv_holds_every_number(tmp_path: Path) -> None:
    save_curves(POINTS, tmp_path)
    rows = list(csv.DictReader((tmp_path / "curves.csv").read_text().splitlines()))
    assert [CurvePoint(**{k: float(v) for k, v in row.items()}) for row in rows] == POINTS


def test_the_picture_is_a_picture(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs matplotlib")
    save_curves(POINTS, tmp_path)
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.size[0] > 500


def test_without_matplotlib_the_csv_is_written_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    save_curves(POINTS, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["curves.csv"]
