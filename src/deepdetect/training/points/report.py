"""What a training of the ranker reports: its curves and a model card."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..._shared.atomic import atomic_path
from .measure import BUDGETS, RADII_PX
from .views import KINDS

MEASURES = [f"@{radius:g} px {budget}" for budget in BUDGETS for radius in RADII_PX] + ["correct"]
"""Columns of a kind: repeatability by budget and radius, and correct matches."""


def save_curves(points: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """Write curves.csv, and curves.png where matplotlib is installed."""
    with atomic_path(folder / "curves.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(
            ["step", "loss", "score", *(f"{kind} {name}" for kind in KINDS for name in MEASURES)]
        )
        for point in points:
            values = [point["loss"], point["score"], *(v for kind in KINDS for v in point[kind])]
            writer.writerow([point["step"], *(f"{value:.6g}" for value in values)])
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    steps = [point["step"] for point in points]
    for column, name in enumerate(MEASURES):
        mean = [sum(point[kind][column] for kind in KINDS) / len(KINDS) for point in points]
        axes.plot(steps, mean, label=name)
    axes.plot(steps, [point["score"] for point in points], "k--", label="score")
    axes.set_xlabel("step")
    axes.set_ylabel("mean over the kinds of pairs")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    with atomic_path(folder / "curves.png") as temporary:
        figure.savefig(temporary, dpi=120)


def write_model_card(
    path: Path,
    weights: Path,
    parameters: int,
    notes: Mapping[str, Any],
    points: Sequence[Mapping[str, Any]],
) -> None:
    """Write a model card as Markdown.

    Args:
        path: of the card.
        weights: the file that it describes.
        parameters: number of the network's parameters.
        notes: of the weights' file.
        points: a row for each measure of the run.
    """
    best = notes["point"]
    options = json.loads(notes["options"])
    lines = [
        "# Model card",
        "",
        f"`{weights.name}`, SHA-256 `{hashlib.sha256(weights.read_bytes()).hexdigest()}`:",
        f"a perceptron of {parameters:,} parameters that ranks maxima of |det Hessian| in a scale",
        "space by how surely they are found again.",
        "",
        "## How good the weights are",
        "",
        "On synthetic pairs of views of the validation photographs, by whose score this step was",
        "chosen: one-to-one repeatability by number of keypoints (of an image of 800x640), and",
        "matches correct to 1 px over the number of keypoints.",
        "",
        *_table(
            ["pairs", *MEASURES],
            [[kind, *(f"{value:.3f}" for value in best[kind])] for kind in KINDS],
        ),
        "",
        f"Score {best['score']:.4f} at step {best['step']:,}.",
        "",
        "## Where they come from",
        "",
        *(f"- {name}: {notes[name]}" for name in sorted(notes) if name not in ("options", "point")),
        "",
        "## Recipe",
        "",
        *_table(["option", "value"], [[name, json.dumps(options[name])] for name in options]),
        "",
        "## Course",
        "",
        *_table(
            ["step", "loss", "score"],
            [[f"{p['step']:,}", f"{p['loss']:.4f}", f"{p['score']:.4f}"] for p in points],
        ),
        "",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    lines = [f"| {' | '.join(row)} |" for row in (header, *rows)]
    return [lines[0], "|---" * len(header) + "|", *lines[1:]]
