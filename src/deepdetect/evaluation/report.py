"""A report: sections of text, tables and figures; written as Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .._shared.atomic import atomic_path
from .._shared.errors import OptionError

Cell = str | int | float | None
"""What a table holds: None is shown as a dash."""


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        title: its heading.
        style: how numbers are written, as ".3f", ",d" or ".1%".
    """

    title: str
    style: str = ""

    def show(self, cell: Cell) -> str:
        """Write a cell as text; an unknown value, NaN or None, is a dash.

        Example:
            >>> Column("density", ".3f").show(0.5), Column("matches", ",d").show(None)
            ('0.500', '–')
        """
        if cell is None or (isinstance(cell, float) and math.isnan(cell)):
            return "–"
        return cell if isinstance(cell, str) else format(cell, self.style)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        key: name of its file, as "oxford_matches".
        title: the line above it.
        columns: from left to right.
        rows: cells, as many as columns in each.
        note: what a reader must know to read it.
        in_text: False for a long one: report.md names its file instead of showing its rows.

    Raises:
        OptionError: a row has another length, or two columns have one title.
    """

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    in_text: bool = True

    def __post_init__(self) -> None:
        titles = [column.title for column in self.columns]
        if len(set(titles)) < len(titles):
            raise OptionError(f"columns of the table {self.key} share a title: {titles}")
        for row in self.rows:
            if len(row) != len(self.columns):
                raise OptionError(
                    f"a row of the table {self.key} has {len(row)} cells for "
                    f"{len(self.columns)} columns"
                )

    def titles(self) -> list[Cell]:
        """Return the first cell of each row."""
        return [row[0] for row in self.rows]

    def shown(self) -> list[list[str]]:
        """Return all cells as text."""
        return [
            [column.show(cell) for column, cell in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]

    def to_markdown(self) -> str:
        """Write the table in Markdown: names to the left, numbers to the right."""

        def line(cells: list[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = "|---|" + "---:|" * (len(self.columns) - 1)
        heads = line([column.title for column in self.columns])
        return "\n".join([heads, rule, *map(line, self.shown())])


@dataclass(frozen=True)
class Figure:
    """A picture.

    Attributes:
        key: name of its file, as "oxford_repeatability".
        title: the line under it, with the numbers it shows.
        png: the file's bytes.
    """

    key: str
    title: str
    png: bytes = field(repr=False)


@dataclass(frozen=True)
class Section:
    """A part of a report.

    Attributes:
        title: its heading.
        text: paragraphs.
        tables, figures: in order; the tables come first.
    """

    title: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class Report:
    """All of a benchmark.

    Attributes:
        title: the heading.
        metadata: how it was made: command, versions, commit, machine, data.
        sections: in order.
        skipped: what was not measured, each with the reason.
        failures: of that, what was wanted and could not be measured.
    """

    title: str
    metadata: dict[str, str]
    sections: tuple[Section, ...]
    skipped: tuple[str, ...] = ()
    failures: tuple[str, ...] = ()

    def tables(self) -> list[Table]:
        """Return the tables of all sections."""
        return [table for section in self.sections for table in section.tables]

    def figures(self) -> list[Figure]:
        """Return the figures of all sections."""
        return [figure for section in self.sections for figure in section.figures]

    def values(self) -> dict[str, Any]:
        """Return the report as plain values: each row a dict by the columns' titles."""
        tables = {
            table.key: {
                "title": table.title,
                "note": table.note,
                "rows": [
                    {c.title: _finite(cell) for c, cell in zip(table.columns, row, strict=True)}
                    for row in table.rows
                ],
            }
            for table in self.tables()
        }
        return {
            "title": self.title,
            "metadata": self.metadata,
            "tables": tables,
            "figures": {figure.key: figure.title for figure in self.figures()},
            "skipped": list(self.skipped),
        }

    def save(self, folder: Path) -> list[Path]:
        """Write report.md, figures/KEY.png, tables/KEY.csv and report.json.

        Returns:
            The files, report.md first.
        """
        return [
            *_save_markdown(self, folder),
            *(_save_csv(table, folder) for table in self.tables()),
            _save_text(folder / "report.json", json.dumps(self.values(), indent=1) + "\n"),
        ]


def _finite(cell: Cell) -> Cell:
    """JSON has no word for infinity and NaN."""
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell


def _save_text(path: Path, text: str) -> Path:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _save_markdown(report: Report, folder: Path) -> list[Path]:
    parts = [f"# {report.title}"]
    for section in report.sections:
        parts += [f"## {section.title}", *section.text]
        for table in section.tables:
            shown = table.to_markdown() if table.in_text else f"In `tables/{table.key}.csv`."
            parts += [f"**{table.title}**", shown, *filter(None, [table.note])]
        parts += [f"![{f.title}](figures/{f.key}.png)\n\n{f.title}" for f in section.figures]
    parts += ["## Skipped", "\n".join(f"- {reason}" for reason in report.skipped) or "- nothing"]
    parts += ["## How this was made"]
    parts += ["\n".join(f"- {name}: {text}" for name, text in report.metadata.items())]
    paths = [_save_text(folder / "report.md", "\n\n".join(parts) + "\n")]
    for figure in report.figures():
        paths.append(folder / "figures" / f"{figure.key}.png")
        with atomic_path(paths[-1]) as temporary:
            temporary.write_bytes(figure.png)
    return paths


def _save_csv(table: Table, folder: Path) -> Path:
    """Write all digits; an unknown value is an empty cell."""
    path = folder / "tables" / f"{table.key}.csv"
    with (
        atomic_path(path) as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(column.title for column in table.columns)
        writer.writerows(
            ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
            for row in table.rows
        )
    return path
