"""What a run reports of its weights: the curves and a model card."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._shared.atomic import atomic_path
from .._shared.records import file_digest
from .checkpoint import Point


def save_curves(points: Sequence[Point], folder: Path) -> None:
    """Write curves.csv, and curves.png (paper, Figure 5)."""
    with atomic_path(folder / "curves.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(points[0])
        writer.writerows(map(_cell, point.values()) for point in points)
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    steps = [point["step"] for point in points]
    for name in points[0]:
        if name.endswith(("loss", "score", "correct")):
            axes.plot(steps, [point[name] for point in points], label=name.replace("_", " "))
    axes.set_xlabel("step")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    with atomic_path(folder / "curves.png") as temporary:
        figure.savefig(temporary, dpi=120)


def write_model_card(
    path: Path,
    weights: Path,
    network: str,
    quality: Sequence[str],
    notes: Mapping[str, Any],
    points: Sequence[Point],
) -> None:
    """Write a model card of a file of weights, with its notes and the curves, as Markdown."""
    options = json.loads(notes["options"])
    known = ("command", "options", "point")
    lines = [
        "# Model card",
        "",
        f"`{weights.name}`, SHA-256 `{file_digest(weights)}`:",
        network,
        "",
        "## How good the weights are",
        "",
        *quality,
        "",
        "## Where they come from",
        "",
        "```sh",
        notes["command"],
        "```",
        "",
        *(f"- {name.replace('_', ' ')}: {notes[name]}" for name in notes if name not in known),
        "",
        "## Recipe",
        "",
        *table(["option", "value"], [[name, json.dumps(options[name])] for name in options]),
        "",
        "## Curves",
        "",
        *table(
            [name.replace("_", " ") for name in points[0]],
            [[_cell(value) for value in point.values()] for point in points],
        ),
        "",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines of a Markdown table."""
    cells = [[cell.replace("|", "\\|") for cell in row] for row in (header, *rows)]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return [lines[0], "|---" * len(header) + "|", *lines[1:]]


def _cell(value: float) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
