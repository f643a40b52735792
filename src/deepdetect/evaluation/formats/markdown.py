"""The report as Markdown, with its figures as PNG files beside it."""

from __future__ import annotations

from pathlib import Path

from ..._shared.atomic import atomic_path
from ..report import Report, Table


def save_markdown(report: Report, folder: Path) -> list[Path]:
    """Write report.md and figures/KEY.png.

    Returns:
        The files.
    """
    paths = []
    for figure in report.figures():
        paths.append(folder / "figures" / f"{figure.key}.png")
        with atomic_path(paths[-1]) as temporary:
            temporary.write_bytes(figure.png)
    parts = [f"# {report.title}"]
    for section in report.sections:
        parts += [f"## {section.title}", *section.text]
        for table in section.tables:
            parts += [f"**{table.title}**", table_text(table)]
            parts += [table.note] if table.note else []
        parts += [f"![{f.title}](figures/{f.key}.png)\n\n{f.title}" for f in section.figures]
    parts += ["## Left out", "\n".join(f"- {reason}" for reason in report.left_out) or "- nothing"]
    origin = "\n".join(f"- {name}: {text}" for name, text in report.origin.items())
    parts += ["## How this was made", origin]
    path = folder / "report.md"
    with atomic_path(path) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    return [path, *paths]


def table_text(table: Table) -> str:
    """Write a table in Markdown: names to the left, numbers to the right."""

    def line(cells: list[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    rule = "|---|" + "---:|" * (len(table.columns) - 1)
    heads = line([column.title for column in table.columns])
    return "\n".join([heads, rule, *map(line, table.shown())])
