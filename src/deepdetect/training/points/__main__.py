"""`python -m deepdetect.training.points`: measure rankers beside their rivals.

python -m deepdetect.training.points photos/val --ranker run/best.npz
"""

from __future__ import annotations

from pathlib import Path

import click

from ..._shared.errors import DeepDetectError

PATH = click.Path(path_type=Path)


@click.command(context_settings={"show_default": True})
@click.argument("validation", type=PATH)
@click.option("--ranker", "rankers", type=PATH, multiple=True, help="A trained ranker; any number.")
@click.option("--rivals/--no-rivals", "with_rivals", default=True, help="Measure the rivals, too.")
@click.option("--pairs-per-kind", default=16, help="Pairs of each kind.")
@click.option("--seed", default=0, help="Of the pairs; training measures by 0.")
@click.option("--threads", default=1, help="Threads of torch.")
def main(
    validation: Path,
    rankers: tuple[Path, ...],
    with_rivals: bool,
    pairs_per_kind: int,
    seed: int,
    threads: int,
) -> None:
    """Print the validation metric of the rivals and of trained rankers."""
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
