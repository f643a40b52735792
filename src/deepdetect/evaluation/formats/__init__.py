"""What a report is written as: one line each.

To add a format, write its module beside this one, with a function
`(report, folder) -> files`, and add its line.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ..report import Report
from .csv import save_csv
from .html import save_html
from .json import report_values, save_json
from .markdown import save_markdown, table_text

FORMATS: dict[str, Callable[[Report, Path], list[Path]]] = {
    "html": save_html,
    "markdown": save_markdown,
    "csv": save_csv,
    "json": save_json,
}


def save_report(report: Report, folder: Path) -> list[Path]:
    """Write a report in all formats.

    Returns:
        The files, the HTML page first.
    """
    return [path for save in FORMATS.values() for path in save(report, folder)]


__all__ = ["FORMATS", "report_values", "save_report", "table_text"]
