"""Labels of image files, written as 1-bit PNG masks by several processes."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.errors import DeepDetectError, MissingExtraError
from .._shared.parallel import TaskMap, map_in_processes
from ..io.image import load_image, luma
from ..io.masks import load_mask_settings, save_mask
from ..viz.draw import save_picture
from .fusion import draw_label, fuse
from .settings import LabelOptions


@dataclass(frozen=True)
class LabelTarget:
    """A mask to be made from an image.

    Attributes:
        mask: the file the mask is written to.
        options: how the label is made.
        figure: the file for the paper's Figure 4 of this label, or None.
        transform: picklable function from the (H, W, 3) uint8 RGB image to the one that is
            labelled; None labels the image as it is.
        image_state: of `image_state`, which is stored in the mask, too; None stores nothing.
    """

    mask: Path
    options: LabelOptions
    figure: Path | None = None
    transform: Callable[[np.ndarray], np.ndarray] | None = None
    image_state: tuple[str, int, int] | None = None

    @property
    def settings(self) -> str:
        """The label options as text, which is stored in the mask file."""
        image = {} if self.image_state is None else {"image": self.image_state}
        return json.dumps({**asdict(self.options), **image}, sort_keys=True)

    @property
    def is_stale(self) -> bool:
        """Whether the mask file exists and was made with other options."""
        return self.mask.exists() and self._stored()[0] != _split_settings(self.settings)[0]

    @property
    def is_of_another_image(self) -> bool:
        """Whether the mask file exists and was made from an image at another place."""
        _, image = self._stored()
        return bool(image) and self.image_state is not None and image[0] != self.image_state[0]

    @property
    def is_done(self) -> bool:
        """Whether the mask, and the figure if one is wanted, exist and the image is the same."""
        if not self.mask.exists() or (self.figure is not None and not self.figure.exists()):
            return False
        _, image = self._stored()
        return not (image and self.image_state) or tuple(image) == self.image_state

    def _stored(self) -> tuple[Any, Any]:
        return _split_settings(load_mask_settings(self.mask))


def image_state(path: Path) -> tuple[str, int, int] | None:
    """Return a digest of an image's place, its size in bytes and the time of its last change.

    It is None where there is no such file. The place itself is not for whom masks are given to.
    """
    try:
        found = path.stat()
    except OSError:
        return None
    place = hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]
    return place, found.st_size, found.st_mtime_ns


def _split_settings(text: str | None) -> tuple[Any, Any]:
    """Split the text in a mask into its settings, and the state of its image; None if unknown."""
    try:
        settings = json.loads(text or "{}")
        image = settings.pop("image", None)
    except (ValueError, AttributeError, TypeError, RecursionError):
        return None, None
    return settings, image if isinstance(image, list) and len(image) == 3 else None


@dataclass(frozen=True)
class LabelTask:
    """An image file, which is read once, and the masks to be made from it."""

    image: Path
    targets: tuple[LabelTarget, ...]


@dataclass(frozen=True)
class LabelReport:
    """The result for one mask.

    Attributes:
        image: the image file.
        mask: the mask file.
        visibility: the settings that were used, "normal" or "low"; None when it failed.
        density: fraction of the pixels that are marked; NaN when it failed.
        error: what went wrong, or None.
    """

    image: Path
    mask: Path
    visibility: str | None = None
    density: float = math.nan
    error: str | None = None


def label_files(
    tasks: Sequence[LabelTask],
    workers: int | None = None,
    callback: Callable[[LabelReport], None] | None = None,
    map_tasks: TaskMap = map_in_processes,
) -> list[LabelReport]:
    """Label image files, in parallel over processes.

    An image that cannot be read is reported, and the others are labelled all the same. A script
    must call this under `if __name__ == "__main__":`, since processes are started.

    Args:
        tasks: the images and their masks.
        workers: number of processes; default one per processor.
        callback: called after each mask.
        map_tasks: what runs them, where it is not the processes of this machine.

    Returns:
        One report per mask, in order of completion.

    Raises:
        OptionError: `workers` is under 1.
        DeepDetectError: a worker process died, or a mask cannot be written.
    """
    reports = []
    for made in map_tasks(label_file, tasks, workers):
        for report in made:
            if callback is not None:
                callback(report)
            reports.append(report)
    return reports


def label_file(task: LabelTask) -> list[LabelReport]:
    """Make the masks of one image file.

    Raises:
        DeepDetectError: a mask cannot be written, or a package is missing, which concerns all
            images.
    """
    reports: list[LabelReport] = []
    image: np.ndarray | None = None
    for target in task.targets:
        try:
            image = load_image(task.image) if image is None else image
            rgb = image if target.transform is None else target.transform(image)
            label = fuse(luma(rgb), target.options)
        except MissingExtraError:  # concerns all images
            raise
        except DeepDetectError as error:
            left = task.targets[len(reports) :]
            return reports + [LabelReport(task.image, t.mask, error=str(error)) for t in left]
        if target.figure is not None:
            save_picture(draw_label(rgb, label), target.figure)
        save_mask(label.mask, target.mask, target.settings)
        reports.append(LabelReport(task.image, target.mask, label.visibility, label.density))
    return reports


def unfinished_tasks(tasks: Iterable[LabelTask]) -> list[LabelTask]:
    """Leave out the targets that are done; `LabelTarget.is_stale` checks their options."""
    left = []
    for task in tasks:
        targets = tuple(target for target in task.targets if not target.is_done)
        if targets:
            left.append(LabelTask(task.image, targets))
    return left
