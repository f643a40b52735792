"""`python -m deepdetect.training.points`: train the ranker, or measure it beside its rivals.

python -m deepdetect.training.points train photos/train photos/val -o run --steps 20000
python -m deepdetect.training.points measure photos/val --ranker run/best.npz
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import click

from ..._shared.errors import DeepDetectError
from .recipe import PointsTrainingOptions

PATH = click.Path(path_type=Path)
DEFAULT = PointsTrainingOptions()


@click.group(context_settings={"show_default": True})
def main() -> None:
    """Train and measure the ranker of keypoints."""


def _recipe_options(function: Any) -> Any:
    """Add an option for each number of the recipe."""
    for each in reversed(dataclasses.fields(PointsTrainingOptions)):
        flag, default = f"--{each.name.replace('_', '-')}", getattr(DEFAULT, each.name)
        settings: dict[str, Any]
        if isinstance(default, tuple):
            settings = {"type": type(default[0]), "nargs": len(default)}
        else:
            settings = {"type": type(default)}
        function = click.option(flag, default=default, **settings)(function)
    return function


@main.command()
@click.argument("photos", type=PATH)
@click.argument("validation", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder of the run.")
@click.option("--measure-every", default=500, help="Steps between two hard measures.")
@click.option("--save-every", default=100, help="Steps between two checkpoints.")
@click.option("--pairs-per-kind", default=16, help="Pairs of the hard measure.")
@click.option("--workers", default=0, help="Processes that render views.")
@click.option("--threads", default=1, help="Threads of torch.")
@click.option("--seconds", default=math.inf, help="Stop after this time; resume later.")
@_recipe_options
def train(
    photos: Path,
    validation: Path,
    output: Path,
    measure_every: int,
    save_every: int,
    pairs_per_kind: int,
    workers: int,
    threads: int,
    seconds: float,
    **values: Any,
) -> None:
    """Train on the folder PHOTOS, measure on the folder VALIDATION.

    Given again, the same command resumes an interrupted run. A line of the log: step, CPU seconds,
    loss, score, then repeatability @1 and @3 px at the lower budget, @1 and @3 px at the higher
    one, as the mean and for each kind; a star marks the best so far, in best.npz.
    """
    import torch

    from .trainer import PointsTrainer

    torch.set_num_threads(threads)
    try:
        PointsTrainer(
            photos,
            validation,
            output,
            PointsTrainingOptions(**values),
            measure_every=measure_every,
            save_every=save_every,
            pairs_per_kind=pairs_per_kind,
            workers=workers,
            log=click.echo,
        ).fit(seconds=seconds)
    except DeepDetectError as error:
        raise click.ClickException(str(error)) from None


@main.command(name="measure")
@click.argument("validation", type=PATH)
@click.option("--ranker", "rankers", type=PATH, multiple=True, help="A trained ranker; any number.")
@click.option("--rivals/--no-rivals", "with_rivals", default=True, help="Measure the rivals, too.")
@click.option("--pairs-per-kind", default=16, help="Pairs of each kind.")
@click.option("--seed", default=0, help="Of the pairs; training measures by 0.")
@click.option("--threads", default=1, help="Threads of torch.")
def measure_all(
    validation: Path,
    rankers: tuple[Path, ...],
    with_rivals: bool,
    pairs_per_kind: int,
    seed: int,
    threads: int,
) -> None:
    """Print the hard measure of the rivals and of trained rankers."""
    import torch

    from ...detector.points.ranker import load_ranker
    from .measure import measure, points_detector, rivals, validation_pairs

    torch.set_num_threads(threads)
    try:
        pairs = validation_pairs(validation, pairs_per_kind, seed=seed)
        detectors = rivals() if with_rivals else {}
        detectors |= {str(path): points_detector(load_ranker(path)) for path in rankers}
        for name, detect in detectors.items():
            click.echo(f"{name:20s} {measure(detect, pairs).row()}")
    except DeepDetectError as error:
        raise click.ClickException(str(error)) from None


if __name__ == "__main__":
    main()
