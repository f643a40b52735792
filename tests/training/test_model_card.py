from __future__ import annotations

import csv
import hashlib
import json
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from PIL import Image

from deepdetect.training.model_card import CurvePoint, save_curves, write_model_card

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


def test_the_model_card_holds_the_metadata_the_options_and_the_losses(tmp_path: Path) -> None:
    weights = tmp_path / "best.safetensors"
    weights.write_bytes(b"weights")
    metadata = {
        "point": json.dumps(asdict(POINTS[1])),
        "options": json.dumps({"seed": 3, "short_sides": [96, 64], "name": "a|b"}),
        "command": "deepdetect train photos -o run",
        "commit": "",
        "versions": "torch 2.13",
        "machine": "a machine",
        "run_on": "cpu",
        "photographs": "1234",
        "photographs_digest": "0123456789abcdef",
        "start": "fedcba",
    }
    write_model_card(tmp_path / "card.md", weights, metadata, POINTS)
    card = (tmp_path / "card.md").read_text()
    assert hashlib.sha256(b"weights").hexdigest() in card
    for text in ("deepdetect train photos -o run", "git commit: not known", "1,234", "fedcba"):
        assert text in card
    assert "| short_sides | [96, 64] |" in card
    assert '"a\\|b"' in card
    assert "- darkened: 0.4000 / 0.500" in card
    assert card.count("\n| 10 |") == card.count("\n| 20 |") == 1
