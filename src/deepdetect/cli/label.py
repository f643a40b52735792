"""`deepdetect label`: fusion masks of images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from .._shared.errors import OptionError
from .._shared.progress import progress
from ..batch.engines import get_engine
from ..labels.batch import LabelTask, label_files
from . import _options as cli
from ._training import Detectors, LabelSettings, chosen_label_settings


def label(
    images: cli.Images,
    /,
    *,
    output: cli.Output,
    detectors: Detectors = None,
    label_settings: LabelSettings = None,
    visibility: Literal["auto", "normal", "low"] = "auto",
    visualize: bool = False,
    overwrite: cli.Overwrite = False,
    engine: cli.Engine = "processes",
    workers: cli.Workers = None,
    as_json: cli.Json = False,
) -> None:
    """Mark the keypoints and edges of images (files or folders) by nine classical detectors.

    Writes a 1-bit PNG mask STEM.png for each image: white where one of the detectors marks the
    pixel. Masks that exist already are skipped, unless their image has changed; what was made of
    another image or with other settings is replaced with --overwrite only. An image that cannot be
    read does not stop the others: they are listed at the end, with exit code 1.

        deepdetect label photos/ -o masks
        deepdetect label photo.jpg -o masks --detectors fast,sobel --visualize

    Args:
        output: Folder for the masks.
        visibility: Detector settings: normal, low, or auto: low when the luma of an image spans
            fewer than 64 grey levels from the 1st to the 99th percentile.
        visualize: Also write STEM_labels.png, the paper's Figure 4.
    """
    folder = cli.output_folder(output)
    map_tasks = get_engine(engine)
    options = replace(chosen_label_settings(detectors, label_settings), visibility=visibility)
    tasks = []
    for image in cli.expand_images(images, folder):
        figure = folder / f"{image.stem}_labels.png" if visualize else None
        tasks.append(LabelTask(image, folder / f"{image.stem}.png", options, figure, overwrite))
    _check_outputs(tasks)
    left = [task for task in tasks if task.outputs.find() is None]
    with progress(len(left), "labelling", "image") as bar:
        reports = label_files(left, workers, lambda _: bar.update(1), map_tasks)
    done = sorted((r for r in reports if r.error is None), key=lambda r: str(r.image))
    failures = [report.error for report in reports if report.error is not None]
    mean = sum(report.density for report in done) / len(done) if done else None
    if as_json:
        names = ("image", "mask", "visibility", "density")
        cli.print_json(
            {
                "labelled": [{name: getattr(report, name) for name in names} for report in done],
                "skipped": len(tasks) - len(left),
                "mean_density": mean,
                "failures": failures,
            }
        )
    else:
        text = f"{len(done)} labelled, {len(tasks) - len(left)} already done"
        if done:
            low = sum(report.visibility == "low" for report in done)
            text += f"; mean density {mean:.3f}, {low} of low visibility"
        print(f"{text} -> {folder}")
    cli.report_failures(failures, len(tasks))


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
