"""Label masks as 1-bit PNG files, made in parallel from image files."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import DeepDetectError, ImageError, OptionError
from .._shared.processes import map_in_processes
from ..io.image import load_image, luma
from .fusion import Label, LabelOptions, fuse

SETTINGS_KEY = "deepdetect-label"
"""Name of the PNG text that tells how a mask was made."""


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


def save_mask(mask: np.ndarray, path: str | Path, settings: str = "") -> None:
    """Write a (H, W) bool mask as a 1-bit PNG, whole or not at all.

    Args:
        mask: the mask.
        path: file ending in .png.
        settings: text kept in the file, by which `mask_settings` tells how it was made.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(encode_mask(mask, settings))


def encode_mask(mask: np.ndarray, settings: str = "") -> bytes:
    """Return a (H, W) bool mask as the content of a 1-bit PNG file."""
    from PIL import Image, PngImagePlugin

    notes = PngImagePlugin.PngInfo()
    if settings:
        notes.add_text(SETTINGS_KEY, settings)
    content = io.BytesIO()
    Image.fromarray(mask).save(content, format="PNG", pnginfo=notes)
    return content.getvalue()


def load_mask(path: str | Path | bytes) -> np.ndarray:
    """Read a mask of any bit depth: True where a pixel is brighter than half.

    In a file that holds zeros and ones only, the ones are True.

    Args:
        path: the file, or its content.

    Returns:
        (H, W) bool.

    Raises:
        ImageError: the file is missing, damaged or no image.
    """
    from PIL import Image

    name = "the mask" if isinstance(path, bytes) else path
    try:
        with Image.open(io.BytesIO(path) if isinstance(path, bytes) else path) as opened:
            deep = opened.mode.startswith("I")  # 16 bits a pixel
            values = np.asarray(opened if deep else opened.convert("L"))
        return values > (0 if values.max() <= 1 else 32767 if deep else 127)
    except FileNotFoundError:
        raise ImageError(f"there is no mask {name}: check the path") from None
    except (OSError, SyntaxError, ValueError) as error:
        raise ImageError(f"{name} is not a mask that can be read ({error})") from None


def mask_settings(path: Path) -> str | None:
    """Return the settings text of a mask file, or None when it has none."""
    from PIL import Image

    try:
        with Image.open(path) as opened:
            return opened.info.get(SETTINGS_KEY)
    except (OSError, SyntaxError, ValueError):
        return None


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
        elif mask_settings(task.mask) != settings_text(task.options):
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
            _save_figure(rgb, label, task.picture)
        save_mask(label.mask, task.mask, settings_text(task.options))
    except DeepDetectError as error:
        return LabelReport(task.image, task.mask, error=str(error))
    return LabelReport(task.image, task.mask, label.visibility, label.density)


def _save_figure(rgb: np.ndarray, label: Label, path: Path) -> None:
    from ..viz.draw import draw_label, save_picture

    save_picture(draw_label(rgb, label), path)
