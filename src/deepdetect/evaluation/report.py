"""A report: sections of text, tables and figures, before it takes any format."""

from __future__ import annotations

from dataclasses import dataclass, field

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
        """Write a cell as text; what is not known, not a number or nothing is a dash.

        Example:
            >>> Column("density", ".3f").show(0.5), Column("matches", ",d").show(None)
            ('0.500', '–')
        """
        if cell is None or (isinstance(cell, float) and cell != cell):
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

    Raises:
        OptionError: a row has another length, or two columns have one title.
    """

    key: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""

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

    def shown(self) -> list[list[str]]:
        """Return all cells as text."""
        return [
            [column.show(cell) for column, cell in zip(self.columns, row, strict=True)]
            for row in self.rows
        ]


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
        origin: how it was made: command, versions, commit, machine, data.
        sections: in order.
        left_out: what was not measured, each with the reason.
    """

    title: str
    origin: dict[str, str]
    sections: tuple[Section, ...]
    left_out: tuple[str, ...] = ()

    def tables(self) -> list[Table]:
        """Return the tables of all sections."""
        return [table for section in self.sections for table in section.tables]

    def figures(self) -> list[Figure]:
        """Return the figures of all sections."""
        return [figure for section in self.sections for figure in section.figures]
