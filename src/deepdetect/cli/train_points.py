"""`deepdetect train-points`: the ranker of keypoints from a folder of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import PATH, json_option, print_json

RECIPE = FieldOptions("training.recipe:PointsTrainingOptions")


@generated_command(RECIPE, short_help="Train the ranker of keypoints on images.")
@click.argument("images", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder of the run.")
@click.option("--validation", type=PATH, required=True, help="Folder of the images to choose by.")
@click.option(
    "--num-workers", default=0, show_default=True, help="Processes that make the training pairs."
)
@json_option
def train_points(
    images: Path, output: Path, validation: Path, num_workers: int, as_json: bool, **values: Any
) -> None:
    """Train the ranker of keypoints on the images in the folder IMAGES.

    Pairs of views are made of single images, so no labels are needed. The run's folder gets
    best.npz (the weights of the highest validation score), MODEL_CARD.md, curves.csv, curves.png
    and checkpoint.safetensors. An interrupted run resumes when the same command is given again.

    \b
    deepdetect train-points photos/train --validation photos/val -o run
    """
    from ..training.run import require_packages

    require_packages()
    from ..training import PointsTrainingOptions
    from ..training import train_points as train_ranker
    from ._records import check_none_made

    check_none_made(images, output)
    options = PointsTrainingOptions(**given_only(values))
    log = None if as_json else click.echo
    result = train_ranker(images, validation, output, options, num_workers=num_workers, log=log)
    best = result.best
    if as_json:
        print_json({"weights": result.weights, "best": best, "points": result.points})
    else:
        click.echo(f"best score {best['score']:.4f} at step {best['step']:,} -> {result.weights}")
