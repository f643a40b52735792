"""A report: rows of values, tables and figures made of them, written as Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import OptionError

Cell = str | int | float | None
"""What a table holds: None is shown as a dash."""

Row = dict[Any, Any]
"""What was measured once: values by name."""

Rows = list[Row]


def where(rows: Iterable[Row], **wanted: Any) -> Rows:
    """Return the rows that have these values.

    Example:
        >>> where([{"scene": "graf", "n": 1}, {"scene": "wall", "n": 2}], scene="wall")
        [{'scene': 'wall', 'n': 2}]
    """
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def mean(rows: Iterable[Row], name: Any) -> float | None:
    """Return the mean of the values of this name that are not NaN; None without any."""
    return mean_of(row[name] for row in rows)


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are not None or NaN; None without any."""
    known = [value for value in values if value is not None and value == value]
    return float(np.mean(known)) if known else None


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

    def values(self) -> list[dict[str, Cell]]:
        """Return each row as a dict by the columns' titles; JSON has no NaN: it becomes None."""
        return [
            {
                column.title: None if isinstance(cell, float) and not math.isfinite(cell) else cell
                for column, cell in zip(self.columns, row, strict=True)
            }
            for row in self.rows
        ]

    def to_markdown(self) -> str:
        """Write the table in Markdown: names to the left, numbers to the right."""

        def line(cells: Iterable[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = "|---|" + "---:|" * (len(self.columns) - 1)
        rows = [[c.show(x) for c, x in zip(self.columns, row, strict=True)] for row in self.rows]
        return "\n".join([line(c.title for c in self.columns), rule, *map(line, rows)])

    def to_csv(self) -> str:
        """Write all digits; an unknown value is an empty cell."""
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        writer.writerow(column.title for column in self.columns)
        writer.writerows(
            ["" if isinstance(cell, float) and math.isnan(cell) else cell for cell in row]
            for row in self.rows
        )
        return text.getvalue()


class Titled(Protocol):
    """What a row of a table is named after."""

    @property
    def name(self) -> str: ...

    @property
    def title(self) -> str: ...


Columns = Sequence[tuple[Column, Callable[[Rows], Cell]]]
"""Columns, and what each makes of the rows of one method."""


def average(title: str, style: str, name: Any, **wanted: Any) -> tuple[Column, Any]:
    """Make the column of the mean of a value, over the rows that have the wanted values."""
    return Column(title, style), lambda rows: mean(where(rows, **wanted), name)


def single(title: str, style: str, name: Any, **wanted: Any) -> tuple[Column, Any]:
    """Make the column of a value of the one row that has the wanted values."""

    def cell(rows: Rows) -> Cell:
        found = where(rows, **wanted)
        value: Cell = found[0][name] if found else None
        return value

    return Column(title, style), cell


def tabulate(
    key: str, title: str, methods: Sequence[Titled], rows: Rows, columns: Columns, note: str = ""
) -> Table:
    """Make a table with a line for each method.

    Args:
        key, title, note: as of `Table`.
        methods: in the order of the lines.
        rows: of `Run.rows`.
        columns: those after the method's title.
    """
    lines = []
    for method in methods:
        own = where(rows, method=method.name)
        lines.append((method.title, *(cell(own) for _, cell in columns)))
    heads = (Column("method"), *(column for column, _ in columns))
    return Table(key, title, heads, tuple(lines), note)


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
    """A part of a report: a heading, paragraphs, tables, then figures."""

    title: str
    text: tuple[str, ...] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()


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
    sections: Sequence[Section]
    skipped: Sequence[str] = ()
    failures: Sequence[str] = ()

    def tables(self) -> list[Table]:
        """Return the tables of all sections."""
        return [table for section in self.sections for table in section.tables]

    def figures(self) -> list[Figure]:
        """Return the figures of all sections."""
        return [figure for section in self.sections for figure in section.figures]

    def values(self) -> dict[str, Any]:
        """Return the report as plain values: each row a dict by the columns' titles."""
        return {
            "title": self.title,
            "metadata": self.metadata,
            "tables": {
                t.key: {"title": t.title, "note": t.note, "rows": t.values()} for t in self.tables()
            },
            "figures": {figure.key: figure.title for figure in self.figures()},
            "skipped": list(self.skipped),
        }

    def save(self, folder: Path) -> list[Path]:
        """Write report.md, figures/KEY.png, tables/KEY.csv and report.json.

        Returns:
            The files, report.md first.
        """
        files = {"report.md": self._markdown().encode()}
        files |= {f"figures/{figure.key}.png": figure.png for figure in self.figures()}
        files |= {f"tables/{table.key}.csv": table.to_csv().encode() for table in self.tables()}
        files["report.json"] = (json.dumps(self.values(), indent=1) + "\n").encode()
        for name, content in files.items():
            with atomic_path(folder / name) as temporary:
                temporary.write_bytes(content)
        return [folder / name for name in files]

    def _markdown(self) -> str:
        parts = [f"# {self.title}"]
        for section in self.sections:
            parts += [f"## {section.title}", *section.text]
            for table in section.tables:
                shown = table.to_markdown() if table.in_text else f"In `tables/{table.key}.csv`."
                parts += [f"**{table.title}**", shown, *filter(None, [table.note])]
            parts += [f"![{f.title}](figures/{f.key}.png)\n\n{f.title}" for f in section.figures]
        skipped = "\n".join(f"- {reason}" for reason in self.skipped) or "- nothing"
        made = "\n".join(f"- {name}: {text}" for name, text in self.metadata.items())
        return "\n\n".join([*parts, "## Skipped", skipped, "## How this was made", made]) + "\n"
