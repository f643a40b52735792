"""The tables of docs/results, and the pages that show them."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("results")


def test_readme_and_pages_show_what_the_results_hold(script: ModuleType) -> None:
    assert script.fill_blocks(write=False) == []
    assert "0.5403" in script.block("reproduction", None)
    assert script.cell("density|DeepDetect, threshold 0.5|mean") == "0.5320"


def test_each_result_names_its_command_and_commit(script: ModuleType) -> None:
    index = json.loads((script.RESULTS_FOLDER / "index.json").read_text())["results"]
    tables = sorted(path.stem for path in script.RESULTS_FOLDER.glob("*.csv"))
    assert sorted(script.RESULTS) == sorted(index) == tables
    for made in index.values():
        assert made["command"]
        assert made["commit"]


def test_a_report_becomes_a_result_and_a_block(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "RESULTS_FOLDER", tmp_path)
    (tmp_path / "index.json").write_text('{"results": {}}')
    method, fraction = "baseline: all pixels (a grid, where there is a budget)", 0.25
    row = {"method": method, "fraction on the foreground": fraction, "keypoints per pixel": 1.0}
    report = {
        "metadata": {"weights (SHA-256)": "default"},
        "tables": {"foreground": {"rows": [row | {"over that of random points": None}]}},
    }
    (tmp_path / "foreground").mkdir()
    (tmp_path / "foreground" / "report.json").write_text(json.dumps(report))
    script.write_result("foreground", tmp_path)
    with (tmp_path / "foreground.csv").open() as file:
        assert list(csv.reader(file))[1] == ["baseline: all pixels", "0.250", "", "", "1.000"]
    made = json.loads((tmp_path / "index.json").read_text())["results"]["foreground"]
    assert made["weights"] == "default"
    assert {"command", "commit", "versions", "machine"} <= set(made)
    assert script.block("foreground", "density").splitlines()[-1] == (
        "| baseline: all pixels | 1.000 |"
    )
    assert script.shown("192540 (.971)") == "192,540 (0.971)"
    assert [script.shown(x) for x in ("0.12345", "6000x4000", "")] == ["0.12345", "6000x4000", "–"]
