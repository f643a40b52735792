"""`deepdetect train-points`: the ranker of keypoints from a folder of images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..training import PointsTrainingOptions
from ..training import train_points as train_ranker
from ..training.run import require_packages
from ._options import From, Json, Output, check_folder_not_made, print_json, with_options


@with_options(From(PointsTrainingOptions, common="steps seed"))
def train_points(
    images: Annotated[Path, Parameter(help="Folder of the images.")],
    /,
    *,
    output: Output,
    validation: Path,
    num_workers: int = 0,
    as_json: Json = False,
    **values: Any,
) -> None:
    """Train the ranker of keypoints on the images in a folder.

    Pairs of views are made of single images, so no labels are needed. The run's folder gets
    best.npz (the weights of the highest validation score), MODEL_CARD.md, curves.csv, curves.png
    and checkpoint.safetensors. An interrupted run resumes when the same command is given again.

        deepdetect train-points photos/train --validation photos/val -o run

    Args:
        output: Folder of the run.
        validation: Folder of the images to choose by.
        num_workers: Processes that make the training pairs.
    """
    require_packages()
    check_folder_not_made(images, output)
    log = None if as_json else print
    options = PointsTrainingOptions(**values)
    result = train_ranker(images, validation, output, options, num_workers=num_workers, log=log)
    best = result.best
    if as_json:
        print_json({"weights": result.weights, "best": best, "points": result.points})
    else:
        print(f"best score {best['score']:.4f} at step {best['step']:,} -> {result.weights}")
