"""Labels of the views of images, made once and kept as 1-bit PNG files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from .._shared.errors import BatchError
from .._shared.progress import progress
from ..io.image import luma
from ..io.masks import load_mask
from ..labels import LabelOptions, fuse
from ..labels.batch import LabelTarget, LabelTask, label_files
from ..labels.visibility import Visibility
from .views import SourceImage, View, render

VISIBILITIES: tuple[Visibility, ...] = ("normal", "low")


class LabelCache:
    """The labels of the views of images, in a subfolder for each set of label settings.

    A label is named by the content of its image: a replaced image gets a new label. The
    visibility among the options is that of the view.
    """

    def __init__(self, folder: Path, options: LabelOptions) -> None:
        self.options = options
        self.folder = folder / settings_digest(options)

    def path(self, image: SourceImage, view: View) -> Path:
        """Return the file of a label."""
        return self.folder / f"{image.path.stem}_{image.digest}_{view.name}.png"

    def load(self, image: SourceImage, view: View) -> np.ndarray:
        """Read a label as (H, W) bool."""
        return load_mask(self.path(image, view))

    def make(
        self,
        wanted: Sequence[tuple[SourceImage, Sequence[View]]],
        workers: int | None = None,
        quiet: bool = True,
    ) -> int:
        """Make the labels that do not exist yet, in parallel; return how many were made.

        Raises:
            BatchError: images cannot be read; the other labels are made all the same.
            DeepDetectError: a label cannot be written.
        """
        there = {path.name for path in self.folder.glob("*.png")} if self.folder.is_dir() else set()
        tasks = []
        for image, views in wanted:
            targets = tuple(
                LabelTarget(
                    self.path(image, view),
                    view_label_options(view, self.options),
                    transform=partial(render, view=view),
                )
                for view in views
                if self.path(image, view).name not in there
            )
            if targets:
                tasks.append(LabelTask(image.path, targets))
        total = sum(len(task.targets) for task in tasks)
        with progress(total, "labels", "label", quiet) as bar:
            reports = label_files(tasks, workers, lambda _: bar.update(1))
        failures = {report.image: report.error for report in reports if report.error is not None}
        if failures:
            raise BatchError(
                f"{len(failures)} of {len(wanted)} images cannot be read, the labels of the "
                "others are kept",
                failures.values(),
            )
        return total


def view_label_options(view: View, options: LabelOptions) -> LabelOptions:
    """Give a dark view the low-visibility settings, a normal one the normal settings."""
    visibility: Visibility = "normal" if view.darkening is None else "low"
    return dataclasses.replace(options, visibility=visibility)


def label_view(rgb: np.ndarray, view: View, options: LabelOptions) -> np.ndarray:
    """Make the label of a view of a (H, W, 3) uint8 RGB image, (H, W) bool."""
    return fuse(luma(render(rgb, view)), view_label_options(view, options)).mask


def settings_digest(options: LabelOptions) -> str:
    """Return a digest of everything a label depends on besides the image and the view."""
    used = [
        (name, *(options.parameters(name, visibility) for visibility in VISIBILITIES))
        for name in options.detectors
    ]
    return hashlib.sha256(repr(used).encode()).hexdigest()[:12]
