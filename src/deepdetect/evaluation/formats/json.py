"""The report as JSON, without its pictures."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from ..._shared.atomic import atomic_path
from ..report import Cell, Report


def save_json(report: Report, folder: Path) -> list[Path]:
    """Write report.json.

    Returns:
        The file, alone in a list.
    """
    path = folder / "report.json"
    with atomic_path(path) as temporary:
        text = json.dumps(report_values(report), indent=1, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    return [path]


def report_values(report: Report) -> dict[str, Any]:
    """Return the report as plain values: each row a dict by the columns' titles."""
    tables = {
        table.key: {
            "title": table.title,
            "note": table.note,
            "rows": [
                {
                    column.title: _finite(cell)
                    for column, cell in zip(table.columns, row, strict=True)
                }
                for row in table.rows
            ],
        }
        for table in report.tables()
    }
    figures = {figure.key: figure.title for figure in report.figures()}
    return {
        "title": report.title,
        "origin": report.origin,
        "tables": tables,
        "figures": figures,
        "left_out": list(report.left_out),
    }


def _finite(cell: Cell) -> Cell:
    """JSON has no word for infinity and for what is not a number."""
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell
