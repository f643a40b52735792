"""`deepdetect train-points`: the ranker of keypoints from a folder of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import PATH, json_option, print_json

POINTS_RECIPE = FieldOptions(
    "training.points.recipe:PointsTrainingOptions",
    names=(
        *("steps", "pairs", "side", "learning_rate", "warm_up", "weight_decay", "average_decay"),
        *("max_gradient_norm", "sharpness", "temperature", "min_density", "max_density"),
        *("close_share", "match_weight", "max_candidates", "seed"),
    ),
)


@generated_command(POINTS_RECIPE, short_help="Train the ranker of keypoints on photographs.")
@click.argument("images", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder of the run.")
@click.option(
    "--validation", type=PATH, required=True, help="Folder of the photographs to choose by."
)
@click.option(
    "--measure-every", default=250, show_default=True, help="Steps from one measure to the next."
)
@click.option(
    "--save-every", default=100, show_default=True, help="Steps from one checkpoint to the next."
)
@click.option(
    "--pairs-per-kind",
    default=24,
    show_default=True,
    help="Validation pairs of each kind: zoom, blur, viewpoint, light.",
)
@click.option(
    "--num-workers", default=0, show_default=True, help="Processes that make the training pairs."
)
@json_option
def train_points(
    images: Path,
    output: Path,
    validation: Path,
    measure_every: int,
    save_every: int,
    pairs_per_kind: int,
    num_workers: int,
    as_json: bool,
    **values: Any,
) -> None:
    """Train the ranker of keypoints on the photographs in the folder IMAGES.

    Pairs of views are made of single photographs, so no labels are needed. The run's folder gets
    best.npz (the weights of the highest validation score), MODEL_CARD.md, curves.csv, curves.png
    and checkpoint.safetensors. An interrupted run resumes when the same command is given again.

    \b
    deepdetect train-points photos/train --validation photos/val -o run
    """
    from ..training.run import require_packages

    require_packages()
    from ..training.points.recipe import PointsTrainingOptions
    from ..training.points.trainer import BEST, PointsTrainer
    from ._records import check_none_made

    check_none_made(images, output)
    trainer = PointsTrainer(
        images,
        validation,
        output,
        PointsTrainingOptions(**given_only(values)),
        measure_every=measure_every,
        save_every=save_every,
        pairs_per_kind=pairs_per_kind,
        workers=num_workers,
        quiet=as_json,
    )
    state = trainer.fit()
    best = max(state.points, key=lambda point: float(point["score"]))
    if as_json:
        print_json({"weights": output / BEST, "best": best, "points": state.points})
    else:
        click.echo(f"best score {best['score']:.4f} at step {best['step']:,} -> {output / BEST}")
