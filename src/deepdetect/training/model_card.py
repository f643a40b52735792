"""What a run reports of its weights: the loss curves and a model card."""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from .._shared.atomic import atomic_path


@dataclass(frozen=True)
class CurvePoint:
    """The losses after a number of steps.

    Attributes:
        step: optimiser steps done.
        epoch: how often each image was seen, on average.
        images: crops seen.
        learning_rate: of the last step.
        training_loss: mean loss of the training batches since the last point.
        validation_loss: mean of `normal_loss` and `dark_loss`, weighted by the dark fraction.
        normal_loss, normal_iou, dark_loss, dark_iou: on the validation images.
    """

    step: int
    epoch: float
    images: int
    learning_rate: float
    training_loss: float
    validation_loss: float
    normal_loss: float
    normal_iou: float
    dark_loss: float
    dark_iou: float


def save_curves(points: Sequence[CurvePoint], folder: Path) -> None:
    """Write curves.csv, and curves.png (paper, Figure 5) where matplotlib is installed."""
    with atomic_path(folder / "curves.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in dataclasses.fields(CurvePoint)])
        writer.writeheader()
        for point in points:
            values = dataclasses.asdict(point).items()
            writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in values})
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    epochs = [point.epoch for point in points]
    for name, label, style in (
        ("training_loss", "training", "C0-"),
        ("validation_loss", "validation", "C1-"),
        ("normal_loss", "validation, normal", "C2:"),
        ("dark_loss", "validation, dark", "C3:"),
    ):
        axes.plot(epochs, [getattr(point, name) for point in points], style, label=label)
    axes.set_xlabel("epoch")
    axes.set_ylabel("binary cross-entropy per pixel")
    axes.grid(alpha=0.3)
    axes.legend()
    with atomic_path(folder / "curves.png") as temporary:
        figure.savefig(temporary, dpi=120)


def write_model_card(
    path: Path, weights: Path, metadata: Mapping[str, str], points: Sequence[CurvePoint]
) -> None:
    """Write a model card as Markdown from the weights' file, its metadata and the loss curves."""
    best = CurvePoint(**json.loads(metadata["point"]))
    options = json.loads(metadata["options"])
    lines = [
        "# Model card",
        "",
        f"`{weights.name}`, SHA-256 `{hashlib.sha256(weights.read_bytes()).hexdigest()}`: ESPNet,",
        "408,039 parameters. Input: RGB in [0, 1]; output: the probability that a pixel is a",
        "keypoint or an edge for one of the label detectors.",
        "",
        "## How good the weights are",
        "",
        "On the validation images, by which these weights were chosen (mean binary",
        "cross-entropy per pixel / intersection over union at threshold 0.5):",
        "",
        f"- normal: {best.normal_loss:.4f} / {best.normal_iou:.3f}",
        f"- darkened: {best.dark_loss:.4f} / {best.dark_iou:.3f}",
        "",
        "## Where they come from",
        "",
        "```sh",
        metadata["command"],
        "```",
        "",
        f"- git commit: {metadata['commit'] or 'not known'}",
        f"- versions: {metadata['versions']}",
        f"- machine: {metadata['machine']}; run on {metadata['run_on']}",
        f"- training images: {int(metadata['photographs']):,}; "
        f"digest of all images: {metadata['photographs_digest']}",
        f"- SHA-256 of the initial weights: {metadata['start']}",
        f"- step {best.step:,}, {best.images:,} crops seen",
        "",
        "## Recipe",
        "",
        *_table(["option", "value"], [[name, json.dumps(options[name])] for name in options]),
        "",
        "## Losses",
        "",
        *_table(
            [field.name.replace("_", " ") for field in dataclasses.fields(CurvePoint)],
            [
                [f"{v:.6g}" if isinstance(v, float) else f"{v:,}" for v in dataclasses.astuple(p)]
                for p in points
            ],
        ),
        "",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    cells = [[cell.replace("|", "\\|") for cell in row] for row in (header, *rows)]
    lines = [f"| {' | '.join(row)} |" for row in cells]
    return [lines[0], "|---" * len(header) + "|", *lines[1:]]
