"""The report as one HTML page that needs no other file and no network."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path

from ..._shared.atomic import atomic_path
from ..report import Figure, Report, Section, Table

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto;
       padding: 0 1rem; color: #1b1f24; background: #fff; }
table { border-collapse: collapse; margin: .5rem 0 1rem; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; }
th, td { padding: .25rem .7rem; border-bottom: 1px solid #d8dee4; text-align: right; }
th:first-child, td:first-child { text-align: left; }
th { background: #f3f5f7; }
tr:hover td { background: #f8fafb; }
caption { text-align: left; font-weight: 600; padding: .3rem 0; }
figure { margin: 1rem 0; } img { max-width: 100%; }
figcaption, .note { color: #57606a; font-size: .9rem; }
"""


def save_html(report: Report, folder: Path) -> list[Path]:
    """Write index.html.

    Args:
        report: the report.
        folder: where to.

    Returns:
        The file, alone in a list.
    """
    contents = "".join(
        f'<li><a href="#s{k}">{escape(section.title)}</a></li>'
        for k, section in enumerate(report.sections)
    )
    body = "".join(_section(section, k) for k, section in enumerate(report.sections))
    origin = "".join(
        f"<tr><td>{escape(name)}</td><td>{escape(text)}</td></tr>"
        for name, text in report.origin.items()
    )
    left_out = "".join(f"<li>{escape(reason)}</li>" for reason in report.left_out)
    page = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(report.title)}</title><style>{STYLE}</style></head><body>"
        f"<h1>{escape(report.title)}</h1><ul>{contents}</ul>{body}"
        f"<h2>Left out</h2><ul>{left_out or '<li>nothing</li>'}</ul>"
        f"<h2>How this was made</h2><table>{origin}</table></body></html>\n"
    )
    path = folder / "index.html"
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return [path]


def _section(section: Section, number: int) -> str:
    text = "".join(f"<p>{escape(paragraph)}</p>" for paragraph in section.text)
    tables = "".join(_table(table) for table in section.tables)
    figures = "".join(_figure(figure) for figure in section.figures)
    return f'<h2 id="s{number}">{escape(section.title)}</h2>{text}{tables}{figures}'


def _table(table: Table) -> str:
    heads = "".join(f"<th>{escape(column.title)}</th>" for column in table.columns)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in table.shown()
    )
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<div class="wide"><table id="{escape(table.key)}"><caption>{escape(table.title)}'
        f"</caption><thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>{note}"
    )


def _figure(figure: Figure) -> str:
    data = base64.b64encode(figure.png).decode("ascii")
    title = escape(figure.title)
    return (
        f'<figure id="{escape(figure.key)}"><img alt="{title}" src="data:image/png;base64,{data}">'
        f"<figcaption>{title}</figcaption></figure>"
    )
