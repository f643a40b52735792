"""Add the numbers that are printed in the paper (in `paper_numbers.toml`) to our tables."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..report import Rows, Table

DEEPDETECT = "DeepDetect, threshold 0.5"

Paper = Mapping[str, Mapping[str, float]]
"""Numbers of a table in the paper, by row title and then by column title."""

NUMBERS: dict[str, Any] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())


def _by_method(name: str) -> Paper:
    printed = dict(NUMBERS[name])
    methods = printed.pop("methods")
    return {
        method: {title: row[k] for title, row in printed.items() if k < len(row)}
        for k, method in enumerate(methods)
    }


DENSITY = {title: density for title, (density, _) in NUMBERS["table_1"].items()}
FOREGROUND = {title: foreground for title, (_, foreground) in NUMBERS["table_1"].items()}
MATCHES, FIGURE_6, FIGURE_8 = (_by_method(name) for name in ("matches", "figure_6", "figure_8"))
OXFORD_REPEATABILITY = _by_method("oxford_repeatability")
HPATCHES_REPEATABILITY = _by_method("hpatches_repeatability")

NOT_IN_DENSITY = "trees"
"""The scene that the paper's mean densities seem to leave out: ours only equal them without it."""


def paper_title(title: str) -> str:
    """Return the title of a row or column that holds the paper's numbers."""
    return f"{title}, in the paper"


def with_paper_rows(table: Table, paper: Paper) -> Table:
    """Insert the paper's numbers as rows below ours. Rows that only the paper has come last."""
    first, *titles = table.columns
    ours = [row[first] for row in table.rows]
    rows: Rows = []
    for row in (*table.rows, *({first: title} for title in paper if title not in ours)):
        if len(row) > 1:
            rows.append(row)
        printed = paper.get(row[first], {})
        numbers = {title: printed[title] for title in titles if title in printed}
        if numbers:
            rows.append({first: paper_title(row[first]), **numbers})
    return replace(table, rows=rows)


def with_paper_column(table: Table, title: str, paper: Mapping[str, float]) -> Table:
    """Insert the paper's numbers, given by row title, as a column to the right of `title`."""
    columns: dict[str, str] = {}
    for name, style in table.columns.items():
        columns[name] = style
        if name == title:
            columns[paper_title(title)] = style
    first = next(iter(columns))
    rows = [{**row, paper_title(title): paper.get(row[first])} for row in table.rows]
    return replace(table, columns=columns, rows=rows)
