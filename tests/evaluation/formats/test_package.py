from __future__ import annotations

import base64
import csv
import io
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect.evaluation.charts import picture
from deepdetect.evaluation.formats import FORMATS, report_values, save_report, table_text
from deepdetect.evaluation.report import Column, Figure, Report, Section, Table

EVIL = "<b>Tom & \"Jerry\"</b> | 'x' <script src=http://evil.example/a.js>"
THIRD = 1 / 3


def png(value: int) -> bytes:
    return picture(np.full((4, 5, 3), value, np.uint8))


@pytest.fixture(scope="module")
def report() -> Report:
    columns = (Column("method"), Column("a|b <c>", ".2f"), Column("count", ",d"))
    rows = (
        (EVIL, THIRD, 1234567),
        ("nothing", None, None),
        ("no number", float("nan"), 0),
        ("endless", float("inf"), -1),
        ("small, with comma", np.nextafter(0.1, 1), 2),
    )
    first = Table("first", f"Title {EVIL}", columns, rows, f"Note {EVIL}")
    second = Table("second", "Second", (Column("method"),), (("one",),))
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
    save_report(report, root)
    return root


class Page(HTMLParser):
    """All tags with their attributes, and the text by tag."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.texts: dict[str, list[str]] = {}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open:
            self.texts.setdefault(self.open[-1], []).append(data)


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    return Page((folder / "index.html").read_text("utf-8"))


def test_all_files_are_written_and_named_with_the_page_first(
    report: Report, tmp_path: Path
) -> None:
    paths = save_report(report, tmp_path)
    assert paths[0] == tmp_path / "index.html"
    assert len(set(paths)) == len(paths)
    assert set(paths) == {path for path in tmp_path.rglob("*") if path.is_file()}
    assert {path.relative_to(tmp_path).as_posix() for path in paths} == {
        *("index.html", "report.md", "figures/fig.png", "figures/other.png"),
        *("tables/first.csv", "tables/second.csv", "report.json"),
    }
    assert set(FORMATS) == {"html", "markdown", "csv", "json"}


def test_the_page_needs_no_other_file_and_no_network(page: Page) -> None:
    assert {tag for tag, _ in page.tags}.isdisjoint({"script", "link", "iframe", "object", "b"})
    for tag, attributes in page.tags:
        for name, value in attributes.items():
            if name in ("src", "srcset", "data", "poster"):
                assert value.startswith("data:image/png;base64,"), (tag, name)
            if name == "href":
                assert value.startswith("#"), value
    style = "".join(page.texts["style"])
    assert "url(" not in style
    assert "@import" not in style


def test_the_page_is_well_formed_and_its_links_lead_somewhere(page: Page) -> None:
    assert page.open == []
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)
    links = [a["href"][1:] for tag, a in page.tags if tag == "a"]
    assert links
    assert set(links) <= set(ids)


def test_the_page_shows_names_as_they_are(page: Page) -> None:
    for tag, text in (
        ("title", f"Report {EVIL}"),
        ("h1", f"Report {EVIL}"),
        ("h2", f"One {EVIL}"),
        ("p", f"Text {EVIL}"),
        ("p", f"Note {EVIL}"),
        ("caption", f"Title {EVIL}"),
        ("th", "a|b <c>"),
        ("td", EVIL),
        ("figcaption", EVIL),
        ("li", f"left {EVIL}"),
    ):
        assert text in page.texts[tag], tag
    assert EVIL in [a.get("alt") for tag, a in page.tags if tag == "img"]


def test_the_page_shows_the_cells_in_their_style(page: Page) -> None:
    cells = page.texts["td"]
    for text in ("0.33", "1,234,567", "–", "inf", "0.10"):
        assert text in cells


def test_the_pictures_inside_the_page_are_the_figures(report: Report, page: Page) -> None:
    sources = [a["src"].partition(",")[2] for tag, a in page.tags if tag == "img"]
    assert [base64.b64decode(source) for source in sources] == [f.png for f in report.figures()]


def test_a_report_of_nothing_says_so(tmp_path: Path) -> None:
    save_report(Report("Empty", {}, ()), tmp_path)
    assert "<li>nothing</li>" in (tmp_path / "index.html").read_text("utf-8")
    assert "- nothing" in (tmp_path / "report.md").read_text("utf-8")
    assert json.loads((tmp_path / "report.json").read_text("utf-8"))["left_out"] == []


def test_csv_has_every_digit_and_empty_cells(report: Report, folder: Path) -> None:
    with (folder / "tables" / "first.csv").open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert head == ["method", "a|b <c>", "count"]
    assert rows[0] == [EVIL, repr(THIRD), "1234567"]
    assert rows[1] == ["nothing", "", ""]
    assert rows[4][0] == "small, with comma"
    assert float(rows[4][1]) == np.nextafter(0.1, 1) != 0.1
    assert len(rows) == 5


def test_what_is_not_a_number_is_an_empty_cell_of_csv_too(folder: Path) -> None:
    """It is what is not known, and a dash in the other formats."""
    with (folder / "tables" / "first.csv").open(newline="", encoding="utf-8") as file:
        rows = list(csv.reader(file))
    assert rows[3] == ["no number", "", "0"]


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
    assert values["origin"]["command"] == EVIL
    assert values["left_out"] == [f"left {EVIL}"]


def test_the_values_do_not_lose_a_table(report: Report) -> None:
    assert list(report_values(report)["tables"]) == [table.key for table in report.tables()]


def test_markdown_tables_have_as_many_cells_in_each_line(report: Report) -> None:
    lines = table_text(report.tables()[0]).splitlines()
    assert len(lines) == 2 + 5
    for line in lines:
        assert line.startswith("|")
        assert line.endswith("|")
        assert len(re.findall(r"(?<!\\)\|", line)) == 4
    assert lines[1] == "|---|---:|---:|"
    assert lines[3] == "| nothing | – | – |"
    assert "a\\|b <c>" in lines[0]


def test_markdown_shows_its_figures_from_files_beside_it(report: Report, folder: Path) -> None:
    text = (folder / "report.md").read_text("utf-8")
    for figure in report.figures():
        assert f"](figures/{figure.key}.png)" in text
        assert (folder / "figures" / f"{figure.key}.png").read_bytes() == figure.png
        Image.open(io.BytesIO(figure.png)).verify()
    assert text.startswith("# Report ")
    assert "## Left out\n\n- left " in text


def test_a_second_report_takes_the_place_of_the_first(report: Report, tmp_path: Path) -> None:
    save_report(report, tmp_path)
    save_report(Report("New", {}, report.sections), tmp_path)
    assert json.loads((tmp_path / "report.json").read_text("utf-8"))["title"] == "New"
    assert not [path for path in tmp_path.rglob(".*") if path.is_file()]


def test_infinity_survives_in_csv(folder: Path) -> None:
    with (folder / "tables" / "first.csv").open(newline="", encoding="utf-8") as file:
        assert math.isinf(float(list(csv.reader(file))[4][1]))
