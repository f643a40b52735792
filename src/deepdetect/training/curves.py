"""Loss curves as CSV and as a picture (paper, Figure 5)."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from .._shared.atomic import atomic_path


@dataclass(frozen=True)
class CurvePoint:
    """The losses after a number of steps.

    Attributes:
        step: optimiser steps done.
        epoch: how often each photograph was seen, on average.
        images: crops seen.
        learning_rate: Adam's rate.
        training_loss: mean loss of the training batches since the last point.
        validation_loss: mean of the next two, weighted by the dark fraction.
        normal_loss, normal_iou, dark_loss, dark_iou: on validation images.
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


def save_curves(points: list[CurvePoint], folder: Path) -> None:
    """Write curves.csv, and curves.png where matplotlib is installed."""
    with atomic_path(folder / "curves.csv") as temporary, temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(CurvePoint)])
        writer.writeheader()
        for point in points:
            writer.writerow(
                {k: f"{v:.6g}" if isinstance(v, float) else v for k, v in asdict(point).items()}
            )
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    epochs = [point.epoch for point in points]
    axes.plot(epochs, [point.training_loss for point in points], label="training", color="C0")
    axes.plot(epochs, [p.validation_loss for p in points], label="validation", color="C1")
    axes.plot(epochs, [p.normal_loss for p in points], ":", label="validation, normal", color="C2")
    axes.plot(epochs, [p.dark_loss for p in points], ":", label="validation, dark", color="C3")
    axes.set_xlabel("epoch")
    axes.set_ylabel("binary cross-entropy a pixel")
    axes.grid(alpha=0.3)
    axes.legend()
    with atomic_path(folder / "curves.png") as temporary:
        figure.savefig(temporary, dpi=120)
