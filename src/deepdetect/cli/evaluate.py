"""`deepdetect evaluate`: how well weights predict known masks."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from .shared import PATH, detector_options, json_option, make_detector, print_json


@click.command(short_help="How well weights predict known masks.")
@click.argument("samples", type=PATH)
@detector_options
@json_option
def evaluate(
    samples: Path,
    as_json: bool,
    **values: Any,
) -> None:
    r"""Score the network on a folder SAMPLES of image_NAME.png with mask_image_NAME.png.

    Prints the mean binary cross-entropy (BCE) and intersection over union (IoU), apart
    for normal and for low-visibility images.

    \b
    deepdetect evaluate samples/
    deepdetect evaluate samples/ --weights run/deepdetect.onnx
    """
    from ..mask_scores import score_samples

    detector = make_detector(values)
    scores = score_samples(detector.heatmap, samples, quiet=as_json)
    if as_json:
        print_json(
            {
                "weights": detector.weights,
                "backend": detector.backend,
                **{name: asdict(score) for name, score in scores.items()},
            }
        )
        return
    click.echo(f"{'visibility':<12}{'images':>8}{'BCE':>9}{'IoU':>8}")
    for name, score in scores.items():
        click.echo(f"{name:<12}{score.images:>8}{score.loss:>9.4f}{score.iou:>8.3f}")
