"""Label masks as 1-bit PNG files, made in parallel from image files."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from .._shared.errors import DeepDetectError, OptionError
from .._shared.processes import map_in_processes
from ..io.image import load_image, luma
from ..io.masks import load_mask_settings, save_mask
from ..viz.draw import save_picture
from .fusion import LabelOptions, draw_label, fuse


@dataclass(frozen=True)
class LabelTask:
    """An image to be labelled.

    Attributes:
        image: the image file.
        mask: the file that the mask is written to.
        picture: the file for the paper's Figure 4, or None.
        options: how the label is made.
    """

    image: Path
    mask: Path
    picture: Path | None
    options: LabelOptions


@dataclass(frozen=True)
class LabelReport:
    """What became of one image.

    Attributes:
        image: the image file.
        mask: the mask file.
        visibility: settings used, "normal" or "low"; None when it failed.
        density: share of marked pixels; None when it failed.
        error: what went wrong, or None.
    """

    image: Path
    mask: Path
    visibility: str | None = None
    density: float | None = None
    error: str | None = None


def settings_text(options: LabelOptions) -> str:
    """Return the text that identifies label options."""
    values = asdict(options)
    if not values["changes"]:
        del values["changes"]  # as before there were any
    return json.dumps(values, sort_keys=True)


def check_outputs(tasks: Sequence[LabelTask]) -> None:
    """Check that no result replaces one of the images.

    Raises:
        OptionError: one would.
    """
    images = {task.image.resolve() for task in tasks}
    for task in tasks:
        for path in (task.mask, task.picture):
            if path is not None and path.resolve() in images:
                raise OptionError(
                    f"the result {path} would replace an image that is to be labelled: "
                    "choose another folder with -o"
                )


def pending(tasks: Sequence[LabelTask]) -> list[LabelTask]:
    """Leave out what is already done with the same settings.

    Raises:
        OptionError: a file is there that was made with other settings or otherwise.
    """
    left = []
    for task in tasks:
        if not task.mask.exists():
            left.append(task)
        elif load_mask_settings(task.mask) != settings_text(task.options):
            raise OptionError(
                f"{task.mask} is there already, made with other settings: "
                "choose another folder with -o, or replace it with --overwrite"
            )
        elif task.picture is not None and not task.picture.exists():
            left.append(task)
    return left


def label_files(
    tasks: Sequence[LabelTask],
    workers: int | None = None,
    advance: Callable[[LabelReport], None] = lambda report: None,
) -> list[LabelReport]:
    """Label image files, in parallel over processes.

    An image that cannot be read is reported; the others are labelled all the same. A
    script must call this under `if __name__ == "__main__":`, since processes are started.

    Args:
        tasks: what to do.
        workers: number of processes; default one for each processor.
        advance: called after each image.

    Returns:
        A report for each task, in the order in which they were ready.
    """
    reports = []
    for report in map_in_processes(label_file, tasks, workers):
        advance(report)
        reports.append(report)
    return reports


def label_file(task: LabelTask) -> LabelReport:
    """Label one image file."""
    try:
        rgb = load_image(task.image)
        label = fuse(luma(rgb), task.options)
        if task.picture is not None:
            save_picture(draw_label(rgb, label), task.picture)
        save_mask(label.mask, task.mask, settings_text(task.options))
    except DeepDetectError as error:
        return LabelReport(task.image, task.mask, error=str(error))
    return LabelReport(task.image, task.mask, label.visibility, label.density)
