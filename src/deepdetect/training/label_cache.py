"""Labels of all views of all photographs, made once and kept as 1-bit PNG files."""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DeepDetectError
from ..image import luma
from ..labels import DETECTORS, LabelOptions, fuse
from ..labels.files import load_mask, save_mask
from ..processes import map_in_processes
from ..progress import progress
from .views import View, render


@dataclass(frozen=True)
class LabelTask:
    """A label to be made: of a view of a photograph, into a file."""

    photo: Path
    view: View
    path: Path
    options: LabelOptions


class LabelCache:
    """The labels of a set of photographs under one folder.

    Args:
        folder: where the labels lie; other label settings get another subfolder.
        root: the folder of the photographs; labels are named by the path below it.
        detectors: names of the label detectors.
    """

    def __init__(self, folder: Path, root: Path, detectors: tuple[str, ...]) -> None:
        self.root = root
        self.detectors = detectors
        self.folder = folder / _settings_digest(detectors)

    def path(self, photo: Path, view: View) -> Path:
        """Return the file of a label."""
        relative = photo.relative_to(self.root)
        # The stem is for people, the checksum tells equal stems in two folders apart.
        name = f"{photo.stem}_{zlib.crc32(relative.as_posix().encode()):08x}_{view.name}.png"
        return self.folder / name

    def load(self, photo: Path, view: View) -> np.ndarray:
        """Read a label as (H, W) bool."""
        return load_mask(self.path(photo, view))

    def make(self, wanted: Iterable[tuple[Path, View]], workers: int | None, quiet: bool) -> int:
        """Make the labels that are not there yet, in parallel over processes.

        Args:
            wanted: photographs and views.
            workers: number of processes; default one for each processor.
            quiet: show no progress bar.

        Returns:
            How many were made.

        Raises:
            DeepDetectError: a photograph cannot be read; the other labels are made all the same.
        """
        there = {path.name for path in self.folder.glob("*.png")} if self.folder.is_dir() else set()
        tasks = []
        for photo, view in wanted:
            path = self.path(photo, view)
            if path.name not in there:
                # A dark view gets the low-visibility settings, a normal one the normal ones.
                visibility = "normal" if view.darkening is None else "low"
                tasks.append(LabelTask(photo, view, path, LabelOptions(self.detectors, visibility)))
        failures = []
        with progress(len(tasks), "labels", "label", quiet) as bar:
            for failure in map_in_processes(make_label, tasks, workers):
                bar.update(1)
                if failure:
                    failures.append(failure)
        if failures:
            raise DeepDetectError(
                f"{len(failures)} of {len(tasks)} labels could not be made, the others are kept; "
                f"the first: {failures[0]}"
            )
        return len(tasks)


def make_label(task: LabelTask) -> str | None:
    """Make one label; return what went wrong, or None."""
    try:
        gray = luma(render(task.photo, task.view))
        save_mask(fuse(gray, task.options).mask, task.path)
    except DeepDetectError as error:
        return str(error)
    return None


def _settings_digest(detectors: tuple[str, ...]) -> str:
    """Name a folder by all that a label depends on besides the photograph and the view."""
    used = [
        (detector.name, repr(detector.normal), repr(detector.low_visibility))
        for detector in DETECTORS
        if detector.name in detectors
    ]
    return hashlib.sha256(repr(used).encode()).hexdigest()[:12]
