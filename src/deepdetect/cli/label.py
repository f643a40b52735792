"""`deepdetect label`: fusion masks of photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .._shared.errors import OptionError
from ._options import (
    PATH,
    chosen_label_settings,
    engine_option,
    expand_images,
    json_option,
    label_settings_option,
    overwrite_option,
    print_json,
    report_failures,
    workers_option,
)

if TYPE_CHECKING:
    from ..labels.batch import LabelTask
    from ..labels.visibility import VisibilityChoice


@click.command(short_help="Training masks from nine classical detectors.")
@click.argument("images", type=PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=PATH, required=True, help="Folder for the masks.")
@click.option(
    "--detectors",
    metavar="NAME,NAME,...",
    help="Some of sift, orb, brisk, fast, agast, harris, shi-tomasi, canny, sobel.  [default: all]",
)
@label_settings_option
@click.option(
    "--visibility",
    default="auto",
    show_default=True,
    help="Detector settings: normal, low, or auto: low when the luma of an image spans fewer "
    "than 64 grey levels from the 1st to the 99th percentile.",
)
@click.option("--visualize", is_flag=True, help="Also write STEM_labels.png, the paper's Figure 4.")
@overwrite_option
@engine_option
@workers_option
@json_option
def label(
    images: tuple[Path, ...],
    output: Path,
    detectors: str | None,
    label_settings: str | None,
    visibility: VisibilityChoice,
    visualize: bool,
    overwrite: bool,
    engine: str,
    workers: int | None,
    as_json: bool,
) -> None:
    """Mark the keypoints and edges of IMAGES (files or folders) by nine classical detectors.

    Writes a 1-bit PNG mask STEM.png for each image: white where one of the detectors
    marks the pixel. Masks that exist already are skipped, unless their image has changed; what
    was made of another image or with other settings is replaced with --overwrite only. An image
    that cannot be read does not stop the others: they are listed at the end, with exit code 1.

    \b
    deepdetect label photos/ -o masks
    deepdetect label photo.jpg -o masks --detectors fast,sobel --visualize
    """
    from .._shared.progress import progress
    from ..batch.engines import get_engine
    from ..labels.batch import LabelTask, label_files

    map_tasks = get_engine(engine)
    options = replace(chosen_label_settings(detectors, label_settings), visibility=visibility)
    tasks = []
    for image in expand_images(images, output):
        figure = output / f"{image.stem}_labels.png" if visualize else None
        tasks.append(LabelTask(image, output / f"{image.stem}.png", options, figure, overwrite))
    _check_outputs(tasks)
    left = [task for task in tasks if task.outputs.find() is None]
    with progress(len(left), "labelling", "image") as bar:
        reports = label_files(left, workers, lambda _: bar.update(1), map_tasks)
    done = [report for report in reports if report.error is None]
    failures = [report.error for report in reports if report.error is not None]
    mean = sum(report.density for report in done) / len(done) if done else None
    low = sum(report.visibility == "low" for report in done)
    if as_json:
        print_json(
            {
                "labelled": [
                    {
                        "image": report.image,
                        "mask": report.mask,
                        "visibility": report.visibility,
                        "density": round(report.density, 6),
                    }
                    for report in sorted(done, key=lambda report: str(report.image))
                ],
                "skipped": len(tasks) - len(left),
                "mean_density": mean,
                "failures": failures,
            }
        )
    else:
        text = f"{len(done)} labelled, {len(tasks) - len(left)} already done"
        if done:
            text += f"; mean density {mean:.3f}, {low} of low visibility"
        click.echo(f"{text} -> {output}")
    report_failures(failures, len(tasks))


def _check_outputs(tasks: Sequence[LabelTask]) -> None:
    """Check that no image is replaced, and no output by another."""
    images = {task.image.resolve() for task in tasks}
    makers: dict[Path, Path] = {}
    for task in tasks:
        for path in task.outputs.paths:
            if path.resolve() in images:
                raise OptionError(
                    f"{path} would replace an image that is to be labelled: "
                    "choose another folder with -o"
                )
            if path in makers:
                raise OptionError(
                    f"{makers[path]} and {task.image} would both write {path}: rename one, or "
                    "leave out --visualize"
                )
            makers[path] = task.image
