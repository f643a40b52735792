"""Reports: tables and charts of measured values, written as Markdown, CSV and JSON."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.opencv import cv2

Cell = str | int | float | None
"""The value of a table's cell; None is shown as a dash."""

Row = dict[Any, Any]
"""The values of one measurement by name."""

Rows = list[Row]


def where(rows: Iterable[Row], **wanted: Any) -> Rows:
    """Return the rows that have these values."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def mean(rows: Iterable[Row], name: Any) -> float | None:
    """Return the mean of the values of this name that are not NaN; None if there are none left."""
    return mean_of(row[name] for row in rows)


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are neither None nor NaN; None if no value is left."""
    known = [value for value in values if value is not None and value == value]
    return float(np.mean(known)) if known else None


@dataclass(frozen=True)
class Table:
    """A table whose key, for example "oxford_matches", is the name of its file.

    The columns give the format specification of their numbers, such as ",d", by title. The rows
    have cells by title; one that is missing, None or NaN is a dash.
    """

    key: str
    title: str
    columns: Mapping[str, str]
    rows: Sequence[Row]
    note: str = ""

    def values(self) -> list[dict[str, Cell]]:
        """Return the rows in the order of the columns; NaN becomes None, since JSON has no NaN."""
        return [
            {
                title: None if isinstance(cell, float) and not math.isfinite(cell) else cell
                for title in self.columns
                for cell in [row.get(title)]
            }
            for row in self.rows
        ]

    def to_markdown(self) -> str:
        """Write the table in Markdown; names are aligned left, numbers right."""

        def line(cells: Iterable[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = "|" + "".join("---:|" if style else "---|" for style in self.columns.values())
        rows = [
            [_shown(row.get(t), style) for t, style in self.columns.items()] for row in self.rows
        ]
        return "\n".join([line(self.columns), rule, *map(line, rows)])

    def to_csv(self) -> str:
        """Write the table as CSV with all digits; unknown values are empty cells."""
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        writer.writerow(self.columns)
        for row in self.rows:
            cells = [row.get(title) for title in self.columns]
            writer.writerow("" if cell is None or cell != cell else cell for cell in cells)
        return text.getvalue()


def _shown(cell: Cell, style: str) -> str:
    """Write a cell as text; None and NaN become a dash."""
    if cell is None or cell != cell:
        return "–"
    return cell if isinstance(cell, str) else format(cell, style)


Measure = Callable[[Rows], Cell]
"""A function from the rows of one method to the value of a cell."""

Columns = Mapping[str, tuple[str, Measure]]
"""Number format and `Measure` of each column, by its title."""


def average(style: str, name: Any, **wanted: Any) -> tuple[str, Measure]:
    """Make a column with the mean of a value over the rows that have the wanted values."""
    return style, lambda rows: mean(where(rows, **wanted), name)


def median(style: str, name: Any) -> tuple[str, Measure]:
    """Make a column with the median of a value over the rows where it is not None."""

    def of_known(rows: Rows) -> Cell:
        known = [row[name] for row in rows if row[name] is not None]
        return float(np.median(known)) if known else None

    return style, of_known


def tabulate(
    key: str,
    title: str,
    methods: Sequence[Any],
    rows: Rows,
    columns: Columns,
    note: str = "",
    groups: Sequence[Row] = ({},),
) -> Table:
    """Make a table from the rows of `Run.rows`, with a line for each method.

    With groups, each combination of their values has its own lines, and they are the first columns.
    """
    lines = []
    for group in groups:
        for method in methods:
            own = where(rows, method=method.name, **group)
            cells = {title: cell(own) for title, (_, cell) in columns.items()}
            lines.append({**group, "method": method.title, **cells})
    styles = {name: "" if isinstance(value, str) else "d" for name, value in groups[0].items()}
    styles |= {"method": ""} | {title: style for title, (style, _) in columns.items()}
    return Table(key, title, styles, lines, note)


@dataclass(frozen=True)
class Figure:
    """A figure: name of its file, caption, and the bytes of the PNG file."""

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
    """The report of a benchmark.

    `metadata` describes the run. `skipped` lists what was not measured, with reasons; `failures`
    are the requested measurements among them that failed.
    """

    title: str
    metadata: dict[str, str]
    sections: Sequence[Section]
    skipped: Sequence[str] = ()
    failures: Sequence[str] = ()

    def tables(self) -> list[Table]:
        """Return the tables of all sections."""
        return [table for section in self.sections for table in section.tables]

    def values(self) -> dict[str, Any]:
        """Return the report as plain values: each row a dict by the columns' titles."""
        return {
            "title": self.title,
            "metadata": self.metadata,
            "tables": {
                t.key: {"title": t.title, "note": t.note, "rows": t.values()} for t in self.tables()
            },
            "figures": {f.key: f.title for section in self.sections for f in section.figures},
            "skipped": list(self.skipped),
        }

    def save(self, folder: Path) -> list[Path]:
        """Write report.md, figures/KEY.png, tables/KEY.csv and report.json; return the files."""
        files = {"report.md": self._markdown().encode()}
        files |= {f"figures/{f.key}.png": f.png for s in self.sections for f in s.figures}
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
                parts += [f"**{table.title}**", table.to_markdown(), *filter(None, [table.note])]
            parts += [f"![{f.title}](figures/{f.key}.png)\n\n{f.title}" for f in section.figures]
        skipped = "\n".join(f"- {reason}" for reason in self.skipped) or "- nothing"
        made = "\n".join(f"- {name}: {text}" for name, text in self.metadata.items())
        return "\n\n".join([*parts, "## Skipped", skipped, "## How this was made", made]) + "\n"


MARKERS = ("o", "s", "^", "x")
DASHES = ("-", "--", ":", "-.")

WIDEST = 1600
"""Wider images are shrunk to this width in pixels. Chosen by hand; not measured."""


def bar_chart(values: Mapping[str, float], label: str, highlighted: Sequence[str] = ()) -> bytes:
    """Draw horizontal bars by name, each with its value; highlighted ones have another colour."""
    figure = _figure(8, 0.32 * len(values) + 1)
    axes = figure.subplots()
    colors = ["C1" if name in highlighted else "C0" for name in values]
    bars = axes.barh(list(values), list(values.values()), color=colors)
    axes.bar_label(bars, fmt="{:.3f}", padding=3)
    axes.invert_yaxis()
    axes.set_xlabel(label)
    axes.set_xlim(left=0)
    axes.margins(x=0.12)
    axes.grid(axis="x", alpha=0.3)
    return _saved(figure)


def line_chart(
    lines: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
) -> bytes:
    """Draw lines of (x, y) values with a legend; a line of one value is drawn as a point."""
    figure = _figure(11, max(4.5, 0.27 * len(lines) + 0.5))
    axes = figure.subplots()
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    for k, (name, (x, y)) in enumerate(lines.items()):
        # Colours repeat after ten lines; markers and dashes then change.
        marker, dash = MARKERS[k // 10 % len(MARKERS)], DASHES[k // 10 % len(DASHES)]
        axes.plot(x, y, label=name, color=f"C{k % 10}", marker=marker, linestyle=dash)
    if lines:
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _saved(figure)


def picture(rgb: np.ndarray) -> bytes:
    """Encode an (H, W, 3) uint8 RGB image as PNG; images wider than `WIDEST` are shrunk."""
    if rgb.shape[1] > WIDEST:
        size = (WIDEST, round(rgb.shape[0] * WIDEST / rgb.shape[1]))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()


def _figure(width: float, height: float) -> Any:
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _saved(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
