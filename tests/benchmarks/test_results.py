"""The tables of docs/results, and the pages that show them."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGES = {
    page.name: page.read_text("utf-8")
    for page in (DOCS.parent / "README.md", *DOCS.glob("*.md"))
    if page.name != "history.md"  # which is of its time
}
NOT_PROSE = re.compile(
    r"<!-- results:.*?<!-- /results -->|^ *```.*?^ *```$|`[^`]*`|\]\([^)]*\)",
    re.DOTALL | re.MULTILINE,
)
FIGURE = re.compile(
    r"\d (?:%|[kMGT]i?B|m?s|seconds|minutes|hours|days)(?!\w)|\d times (?:as|faster)|(?<!\w)\.\d{3}"
)
"""A number with a unit of what is measured, or a fraction of many digits."""

CONSTANTS = (
    *("(3 GB,", "(19 GB)"),  # of data sets
    "need 0.6 TB",  # 279 bytes times the number of points
    *("8 GB of address space", "over 60 % of the tracks", "over 1 % or", "# 5 % of"),  # of the code
    *("99.95 %", "97 %", "(95 %"),  # what `make test-web` asks for
)


@pytest.fixture(scope="module")
def script(load_script: Callable[[str], ModuleType]) -> ModuleType:
    return load_script("results")


def test_readme_and_pages_show_what_the_results_hold(script: ModuleType) -> None:
    assert script.fill_blocks(write=False) == []
    assert "0.5403" in script.block("reproduction", None)
    assert script.cell("density|DeepDetect, threshold 0.5|mean") == "0.5346"


@pytest.mark.parametrize("page", PAGES)
def test_figures_stand_in_results_alone(page: str) -> None:
    assert re.findall(r"\b(?=[a-f]*\d)[\da-f]{7,40}:\w+", PAGES[page]) == []
    text = NOT_PROSE.sub("", PAGES[page])
    for phrase in CONSTANTS:
        text = text.replace(phrase, "")
    assert [text[m.start() - 40 : m.end()] for m in FIGURE.finditer(text)] == []


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


def test_rows_of_own_sizes_become_a_column(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(script, "RESULTS_FOLDER", tmp_path)
    (tmp_path / "index.json").write_text('{"results": {}}')
    names = ("DeepDetect, points", f"DeepDetect, points{script.OWN}")
    tables = {
        "oxford_refined_repeatability_1px": [{"method": name, "2,048": 0.5} for name in names],
        "oxford_refined_homography": [
            {"method": name, "accuracy at 1 px": value}
            for name, value in zip(names, (0.25, 0.75), strict=True)
        ],
    }
    report = {"metadata": {}, "tables": {key: {"rows": rows} for key, rows in tables.items()}}
    (tmp_path / "oxford-standard").mkdir()
    (tmp_path / "oxford-standard" / "report.json").write_text(json.dumps(report))
    script.write_result("points", tmp_path)
    assert script.block("points", "@1 2048|within 1 px|own size and angle").splitlines()[2:] == [
        "| points | 0.500 | 0.250 | 0.750 |"
    ]
