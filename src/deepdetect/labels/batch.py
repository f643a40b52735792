"""Labels of image files, written as 1-bit PNG masks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from .._shared.errors import DeepDetectError, MissingExtraError
from .._shared.records import Outputs
from ..io.image import load_image, luma
from ..io.masks import save_mask
from ..viz.draw import save_picture
from .fusion import draw_label, fuse
from .settings import LabelOptions


@dataclass(frozen=True)
class LabelTask:
    """A mask to be made from an image file; `figure` is the paper's Figure 4 of this label."""

    image: Path
    mask: Path
    options: LabelOptions
    figure: Path | None = None
    overwrite: bool = False

    @property
    def outputs(self) -> Outputs:
        """The files, and the records of what they were made from."""
        paths = [self.mask] if self.figure is None else [self.mask, self.figure]
        return Outputs(paths, [self.image], {"label": self.options}, self.overwrite)


@dataclass(frozen=True)
class LabelReport:
    """The result for one mask: its settings and the marked fraction, or an error."""

    image: Path
    mask: Path
    visibility: str | None = None
    density: float = math.nan
    error: str | None = None


def label_file(task: LabelTask) -> LabelReport:
    """Make the mask of an image file; what is wrong with the image is reported."""
    try:
        rgb = load_image(task.image)
        label = fuse(luma(rgb), task.options)
    except MissingExtraError:  # concerns all images
        raise
    except DeepDetectError as error:
        return LabelReport(task.image, task.mask, error=str(error))
    with task.outputs.writing():
        if task.figure is not None:
            save_picture(draw_label(rgb, label), task.figure)
        save_mask(label.mask, task.mask)
    return LabelReport(task.image, task.mask, label.visibility, label.density)
