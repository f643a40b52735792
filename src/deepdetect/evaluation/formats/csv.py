"""The tables of the report as CSV files, with full precision."""

from __future__ import annotations

import csv
from pathlib import Path

from ..._shared.atomic import atomic_path
from ..report import Report


def save_csv(report: Report, folder: Path) -> list[Path]:
    """Write tables/KEY.csv for each table; what is not known is an empty cell.

    Returns:
        The files.
    """
    paths = []
    for table in report.tables():
        paths.append(folder / "tables" / f"{table.key}.csv")
        with (
            atomic_path(paths[-1]) as temporary,
            temporary.open("w", newline="", encoding="utf-8") as file,
        ):
            writer = csv.writer(file)
            writer.writerow(column.title for column in table.columns)
            # What is not a number is the only value that differs from itself.
            writer.writerows(
                ["" if cell is None or cell != cell else cell for cell in row] for row in table.rows
            )
    return paths
