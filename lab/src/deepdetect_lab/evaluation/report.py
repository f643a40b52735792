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
"""The values of one measurement, keyed by their names."""

Rows = list[Row]


def where(rows: Iterable[Row], **wanted: Any) -> Rows:
    """Return the rows that have all the wanted values, given as name=value."""
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def mean(rows: Iterable[Row], name: Any) -> float | None:
    """Return the mean of the rows' values `name` without None and NaN; None if no value is left."""
    return mean_of(row[name] for row in rows)


def mean_of(values: Iterable[float | None]) -> float | None:
    """Return the mean of the values that are neither None nor NaN; None if no value is left."""
    known = [value for value in values if value is not None and value == value]
    return float(np.mean(known)) if known else None


@dataclass(frozen=True)
class Table:
    """A table of a report. Its `key`, for example "oxford_matches", names its file.

    `columns` maps each column's title to its number format, for example ",d", or "" for text. Each
    row maps column titles to cells. A cell that is missing, None or NaN is shown as a dash.
    """

    key: str
    title: str
    columns: Mapping[str, str]
    rows: Sequence[Row]
    note: str = ""

    def values(self) -> list[dict[str, Cell]]:
        """Return the rows with cells in column order. NaN and inf become None: JSON has neither."""
        return [
            {
                title: None if isinstance(cell, float) and not math.isfinite(cell) else cell
                for title in self.columns
                for cell in [row.get(title)]
            }
            for row in self.rows
        ]

    def to_markdown(self) -> str:
        """Return the table as Markdown, with text aligned left and numbers aligned right."""

        def line(cells: Iterable[str]) -> str:
            return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

        rule = "|" + "".join("---:|" if style else "---|" for style in self.columns.values())
        rows = [
            [_shown(row.get(t), style) for t, style in self.columns.items()] for row in self.rows
        ]
        return "\n".join([line(self.columns), rule, *map(line, rows)])

    def to_csv(self) -> str:
        """Return the table as CSV with unrounded numbers. Missing cells, None and NaN are empty."""
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        writer.writerow(self.columns)
        for row in self.rows:
            cells = [row.get(title) for title in self.columns]
            writer.writerow("" if cell is None or cell != cell else cell for cell in cells)
        return text.getvalue()


def _shown(cell: Cell, style: str) -> str:
    if cell is None or cell != cell:
        return "–"
    return cell if isinstance(cell, str) else format(cell, style)


Measure = Callable[[Rows], Cell]
"""A function that computes the value of a table cell from all rows of one method."""

Columns = Mapping[str, tuple[str, Measure]]
"""The number format and the `Measure` of each column, keyed by the column's title."""


def average(style: str, name: Any, **wanted: Any) -> tuple[str, Measure]:
    """Make a column with the mean of the value `name` over rows that have the `wanted` values."""
    return style, lambda rows: mean(where(rows, **wanted), name)


def median(style: str, name: Any) -> tuple[str, Measure]:
    """Make a column with the median of the value `name` over the rows where it is not None."""

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
    """Make a table from the rows of `Run.rows`, with one line for each method.

    Each of the `groups`, for example {"scene": "graf"}, gets its own lines, computed from the rows
    that have the group's values. The first columns show these values.
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
    """A figure: `key` names its file, `title` is its caption, `png` is the content of the file."""

    key: str
    title: str
    png: bytes = field(repr=False)


@dataclass(frozen=True)
class Section:
    """A section of a report: a heading, then paragraphs (`text`), then tables, then figures."""

    title: str
    text: tuple[str, ...] = ()
    tables: Sequence[Table] = ()
    figures: Sequence[Figure] = ()


@dataclass(frozen=True)
class Report:
    """The report of a benchmark.

    `metadata` describes how the report was made (command, versions, times). `skipped` lists
    everything that was not measured, with reasons. `failures` lists only the requested measurements
    that failed.
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
        """Return the report as values for a JSON file. Table rows are dicts by column title."""
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
        """Write report.md, figures/KEY.png, tables/KEY.csv and report.json; return their paths."""
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
"""Images in a report are shrunk to at most this width in pixels. Chosen by hand."""


def bar_chart(values: Mapping[str, float], label: str, highlighted: Sequence[str] = ()) -> bytes:
    """Draw a horizontal bar for each name; return a PNG. `highlighted` bars have another colour."""
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
    """Draw a line through the (x, y) points of each name, with a legend; return a PNG."""
    figure = _figure(11, max(4.5, 0.27 * len(lines) + 0.5))
    axes = figure.subplots()
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    for k, (name, (x, y)) in enumerate(lines.items()):
        # There are only ten colours, so every ten lines the marker and the dash pattern change.
        marker, dash = MARKERS[k // 10 % len(MARKERS)], DASHES[k // 10 % len(DASHES)]
        axes.plot(x, y, label=name, color=f"C{k % 10}", marker=marker, linestyle=dash)
    if lines:
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _saved(figure)


def picture(rgb: np.ndarray) -> bytes:
    """Encode an (H, W, 3) uint8 RGB image as PNG, shrunk if it is wider than `WIDEST`."""
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
