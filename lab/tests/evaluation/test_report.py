from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from deepdetect_lab.evaluation.report import Figure, Report, Section, Table, picture

EVIL = "<b>Tom & \"Jerry\"</b> | 'x' <script src=http://evil.example/a.js>"
THIRD = 1 / 3


def png(value: int) -> bytes:
    return picture(np.full((4, 5, 3), value, np.uint8))


@pytest.fixture(scope="module")
def report() -> Report:
    columns = {"method": "", "a|b <c>": ".2f", "count": ",d"}
    rows = [
        {"method": EVIL, "a|b <c>": THIRD, "count": 1234567},
        {"method": "nothing", "a|b <c>": None},
        {"method": "no number", "a|b <c>": float("nan"), "count": 0},
        {"method": "endless", "a|b <c>": float("inf"), "count": -1, "of no column": 3},
        {"method": "small, with comma", "a|b <c>": np.nextafter(0.1, 1), "count": 2},
    ]
    first = Table("first", f"Title {EVIL}", columns, rows, f"Note {EVIL}")
    second = Table("second", "Second", {"method": ""}, [{"method": "one"}])
    return Report(
        f"Report {EVIL}",
        {"command": EVIL, "weights": "w.onnx"},
        (
            Section(f"One {EVIL}", (f"Text {EVIL}",), (first,), (Figure("fig", EVIL, png(9)),)),
            Section("Two", (), (second,), (Figure("other", "Other", png(200)),)),
        ),
        (f"left {EVIL}",),
    )


@pytest.fixture(scope="module")
def folder(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("report")
    report.save(root)
    return root


def test_csv_has_every_digit_and_empty_cells(report: Report, folder: Path) -> None:
    with (folder / "tables" / "first.csv").open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert head == ["method", "a|b <c>", "count"]
    assert rows[0] == [EVIL, repr(THIRD), "1234567"]
    assert rows[1] == ["nothing", "", ""]
    assert rows[4][0] == "small, with comma"
    assert float(rows[4][1]) == np.nextafter(0.1, 1) != 0.1
    assert len(rows) == 5


def test_json_has_every_digit_and_no_word_that_json_lacks(folder: Path) -> None:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    text = (folder / "report.json").read_text("utf-8")
    values = json.loads(text, parse_constant=refuse)
    rows = values["tables"]["first"]["rows"]
    assert rows[0] == {"method": EVIL, "a|b <c>": THIRD, "count": 1234567}
    assert [row["a|b <c>"] for row in rows[1:4]] == [None, None, None]
    assert rows[4]["a|b <c>"] == np.nextafter(0.1, 1)
    assert values["figures"] == {"fig": EVIL, "other": "Other"}
    assert values["metadata"]["command"] == EVIL
    assert values["skipped"] == [f"left {EVIL}"]


def test_markdown_tables_have_as_many_cells_in_each_line(report: Report) -> None:
    lines = report.tables()[0].to_markdown().splitlines()
    assert len(lines) == 2 + 5
    for line in lines:
        assert line.startswith("|")
        assert line.endswith("|")
        assert len(re.findall(r"(?<!\\)\|", line)) == 4
    assert lines[1] == "|---|---:|---:|"
    assert lines[3] == "| nothing | – | – |"
    assert "a\\|b <c>" in lines[0]
