"""A model card for the weights of a run: where they come from and how good they are."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from .._shared.atomic import atomic_path
from .curves import CurvePoint


def write_model_card(
    path: Path, weights: Path, notes: Mapping[str, str], points: Sequence[CurvePoint]
) -> None:
    """Write the card as Markdown.

    Args:
        path: the card.
        weights: the safetensors file that it describes.
        notes: the notes in that file's header: command, commit, versions, options, data.
        points: the loss curves.
    """
    best = CurvePoint(**json.loads(notes["point"]))
    lines = [
        "# Model card",
        "",
        f"`{weights.name}`, SHA-256 `{hashlib.sha256(weights.read_bytes()).hexdigest()}`: ESPNet,",
        "408,039 parameters. Input: RGB in [0, 1]; output: the probability that a pixel is a",
        "keypoint or an edge for one of the label detectors.",
        "",
        "## How good the weights are",
        "",
        "On photographs held out, by which these weights were chosen (mean binary",
        "cross-entropy a pixel / intersection over union at threshold 0.5):",
        "",
        f"- normal: {best.normal_loss:.4f} / {best.normal_iou:.3f}",
        f"- darkened: {best.dark_loss:.4f} / {best.dark_iou:.3f}",
        "",
        "## Where they come from",
        "",
        "```sh",
        notes["command"],
        "```",
        "",
        f"- git commit: {notes['commit'] or 'not known'}",
        f"- versions: {notes['versions']}",
        f"- machine: {notes['machine']}; run on {notes['run_on']}",
        f"- photographs to train on: {int(notes['photographs']):,}; "
        f"digest of all photographs: {notes['photographs_digest']}",
        f"- SHA-256 of the state it started from: {notes['start']}",
        f"- step {best.step:,}, {best.images:,} images seen",
        "",
        "## Recipe",
        "",
        "| option | value |",
        "|---|---|",
        *(f"| {name} | {_cell(value)} |" for name, value in json.loads(notes["options"]).items()),
        "",
        "## Losses",
        "",
        *_table(points),
        "",
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def _cell(value: object) -> str:
    text = json.dumps(value)
    return text.replace("|", "\\|")


def _table(points: Sequence[CurvePoint]) -> list[str]:
    names = [field.name for field in dataclasses.fields(CurvePoint)]
    rows = [
        f"| {' | '.join(name.replace('_', ' ') for name in names)} |",
        "|---" * len(names) + "|",
    ]
    for point in points:
        values = [
            f"{value:.6g}" if isinstance(value, float) else f"{value:,}"
            for value in (getattr(point, name) for name in names)
        ]
        rows.append(f"| {' | '.join(values)} |")
    return rows
