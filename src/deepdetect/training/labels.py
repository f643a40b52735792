"""Labels of the views of images, made once and kept as 1-bit PNG files."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from .._shared.records import key
from ..io.image import luma
from ..io.masks import load_mask
from ..labels import LabelOptions, fuse
from ..labels.visibility import Visibility
from .views import SourceImage, View


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

    def missing(self, image: SourceImage, views: tuple[View, ...]) -> tuple[View, ...]:
        """Return the views of an image that have no label yet."""
        return tuple(view for view in views if not self.path(image, view).exists())


def label_view(rgb: np.ndarray, view: View, options: LabelOptions) -> np.ndarray:
    """Make the label, (H, W) bool, of a rendered view, (H, W, 3) uint8 RGB.

    A dark view gets the low-visibility settings, a normal one the normal settings.
    """
    visibility: Visibility = "normal" if view.darkening is None else "low"
    return fuse(luma(rgb), dataclasses.replace(options, visibility=visibility)).mask


def settings_digest(options: LabelOptions) -> str:
    """Return a digest of everything a label depends on besides the image and the view."""
    names = options.detectors
    used = {n: [options.parameters(n, "normal"), options.parameters(n, "low")] for n in names}
    return key(used)[:12]
