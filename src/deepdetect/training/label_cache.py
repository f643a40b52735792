"""Labels of all views of all photographs, made once and kept as 1-bit PNG files."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .._shared.errors import DeepDetectError
from .._shared.processes import map_in_processes
from .._shared.progress import progress
from ..io.image import load_image, luma
from ..io.masks import load_mask, save_mask
from ..labels import LabelOptions, fuse
from ..labels.detectors import select_detectors
from ..labels.settings import settings_for
from ..labels.visibility import Visibility
from .photos import Photo
from .views import View, render

VISIBILITIES: tuple[Visibility, ...] = ("normal", "low")


@dataclass(frozen=True)
class PhotoLabelTask:
    """The labels of one photograph that are to be made.

    Attributes:
        photo: the photograph's file.
        views: the views, each with the file of its label.
        options: the label options; each view decides the visibility itself.
    """

    photo: Path
    views: tuple[tuple[View, Path], ...]
    options: LabelOptions


class LabelCache:
    """The labels of photographs under one folder.

    A label is named by the content of its photograph, so photographs of the same name
    do not get each other's labels, and a replaced one gets a new label.

    Args:
        folder: where the labels lie; other label settings get another subfolder.
        options: the label options; each view decides the visibility itself.
    """

    def __init__(self, folder: Path, options: LabelOptions) -> None:
        self.options = options
        self.folder = folder / settings_digest(options)

    def path(self, photo: Photo, view: View) -> Path:
        """Return the file of a label."""
        return self.folder / f"{photo.path.stem}_{photo.digest}_{view.name}.png"

    def load(self, photo: Photo, view: View) -> np.ndarray:
        """Read a label as (H, W) bool."""
        return load_mask(self.path(photo, view))

    def make(
        self, wanted: Sequence[tuple[Photo, Sequence[View]]], workers: int | None, quiet: bool
    ) -> int:
        """Make the labels that are not there yet, in parallel over processes.

        Args:
            wanted: photographs, each with the views that are needed.
            workers: number of processes; default one for each processor.
            quiet: show no progress bar.

        Returns:
            How many were made.

        Raises:
            DeepDetectError: a photograph cannot be read; the other labels are made all the same.
        """
        there = {path.name for path in self.folder.glob("*.png")} if self.folder.is_dir() else set()
        tasks = []
        for photo, views in wanted:
            paths = [(view, self.path(photo, view)) for view in views]
            missing = tuple((view, path) for view, path in paths if path.name not in there)
            if missing:
                tasks.append(PhotoLabelTask(photo.path, missing, self.options))
        total = sum(len(task.views) for task in tasks)
        failures = []
        with progress(total, "labels", "label", quiet) as bar:
            for done, failure in map_in_processes(make_labels, tasks, workers):
                bar.update(done)
                if failure:
                    failures.append(failure)
        if failures:
            raise DeepDetectError(
                f"{len(failures)} of {len(wanted)} photographs cannot be read, the labels of the "
                f"others are kept; the first: {failures[0]}"
            )
        return total


def make_labels(task: PhotoLabelTask) -> tuple[int, str | None]:
    """Make the labels of one photograph; return how many, and what went wrong, or None."""
    try:
        rgb = load_image(task.photo)
        for view, path in task.views:
            save_mask(label_of_view(rgb, view, task.options), path)
    except DeepDetectError as error:
        return len(task.views), str(error)
    return len(task.views), None


def label_of_view(rgb: np.ndarray, view: View, options: LabelOptions) -> np.ndarray:
    """Make the label of a view of a (H, W, 3) uint8 RGB photograph, (H, W) bool.

    A dark view gets the low-visibility settings, a normal one the normal ones.
    """
    visibility = "normal" if view.darkening is None else "low"
    options = dataclasses.replace(options, visibility=visibility)
    return fuse(luma(render(rgb, view)), options).mask


def settings_digest(options: LabelOptions) -> str:
    """Name a folder by all that a label depends on besides the photograph and the view."""
    used = [
        (detector.name, *(repr(settings_for(detector, v, options.changes)) for v in VISIBILITIES))
        for detector in select_detectors(options.detectors)
    ]
    return hashlib.sha256(repr(used).encode()).hexdigest()[:12]
