"""Keypoint-edge fusion: the pixelwise OR of the label detectors (paper, Section III-A).

`fuse` labels an image in memory. `label_file` labels an image file, and writes the mask as a 1-bit
PNG file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from skimage.util import montage

from deepdetect._shared.errors import DeepDetectError, MissingExtraError
from deepdetect._shared.image_array import Channels, check_channels
from deepdetect._shared.options import suggest_keywords
from deepdetect._shared.records import Outputs
from deepdetect.io.image import load_image, luma
from deepdetect.io.masks import save_mask
from deepdetect.io.picture_file import save_picture
from deepdetect.viz.draw import add_caption

from .detectors import DETECTORS
from .settings import LabelOptions, Visibility

LOW_VISIBILITY_RANGE = 64
"""An image has low visibility if its luma spans fewer grey levels than this (`visibility_of`)."""


@dataclass(frozen=True, eq=False, repr=False)
class Label:
    """The label of an image, made by keypoint-edge fusion.

    Attributes:
        keypoints: (H, W) bool, pixels marked by at least one keypoint detector.
        edges: (H, W) bool, pixels marked by at least one edge detector.
        visibility: the settings that the detectors used, those for "normal" or "low" visibility.
    """

    keypoints: np.ndarray
    edges: np.ndarray
    visibility: Visibility

    @cached_property
    def mask(self) -> np.ndarray:
        """(H, W) bool, the pixelwise OR of `keypoints` and `edges`."""
        return self.keypoints | self.edges

    def __repr__(self) -> str:
        height, width = self.mask.shape
        return f"Label({width}x{height}, density {self.density:.3f}, {self.visibility} visibility)"

    @property
    def density(self) -> float:
        """Fraction of marked pixels."""
        return float(self.mask.mean())


def visibility_of(gray: np.ndarray) -> Visibility:
    """Decide whether an image has normal or low visibility, which selects detector settings.

    An image has low visibility if its luma spans fewer than 64 grey levels between the 1st and the
    99th percentile. The paper's darkened images span at most 32, normal images at least 146 levels.

    Args:
        gray: (H, W) uint8 luma.

    Returns:
        "normal" or "low".

    Example:
        >>> visibility_of(np.full((16, 16), 20, np.uint8))
        'low'
    """
    cumulative = np.cumsum(np.bincount(gray.ravel(), minlength=256)) / gray.size
    darkest, brightest = np.searchsorted(cumulative, [0.01, 0.99])
    return "low" if brightest - darkest < LOW_VISIBILITY_RANGE else "normal"


@suggest_keywords
def fuse(
    image: Any, options: LabelOptions = LabelOptions(), *, channels: Channels = "rgb"
) -> Label:
    """Run the chosen detectors on the luma of an image and fuse their masks.

    Args:
        image: (H, W) uint8 luma, or an image in any form that `load_image` accepts.
        options: detectors and their settings.
        channels: order of the colour channels if the image is an array, as in `load_image`.

    Returns:
        The label, whose `mask` is the pixelwise OR of the detectors' masks.

    Raises:
        ImageError: the image cannot be read or is unsuitable.

    Example:
        >>> square = np.zeros((32, 32), np.uint8)
        >>> square[8:24, 8:24] = 255
        >>> label = fuse(square, LabelOptions(detectors=("harris", "sobel")))
        >>> bool(label.mask[8, 8]), bool(label.mask[0, 0])
        (True, False)
    """
    check_channels(channels)
    is_gray = isinstance(image, np.ndarray) and image.ndim == 2 and image.dtype == np.uint8
    gray = image if is_gray else luma(load_image(image, channels=channels))
    visibility = visibility_of(gray) if options.visibility == "auto" else options.visibility
    marked = {"keypoint": np.zeros(gray.shape, bool), "edge": np.zeros(gray.shape, bool)}
    for name in options.detectors:
        settings = options.parameters(name, visibility)
        marked[DETECTORS[name].kind] |= DETECTORS[name].mask(gray, **settings)
    return Label(marked["keypoint"], marked["edge"], visibility)


def draw_label(rgb: np.ndarray, label: Label) -> np.ndarray:
    """Draw a picture like the paper's Figure 4: image, keypoint mask, edge mask, combined mask.

    Returns:
        The four panels in a row. The caption of a mask gives the percentage of marked pixels.
    """
    panels = [add_caption(rgb, f"image ({label.visibility} visibility settings)")]
    masks = {"keypoints": label.keypoints, "edges": label.edges, "combined": label.mask}
    for name, mask in masks.items():
        picture = np.repeat((mask * np.uint8(255))[:, :, None], 3, 2)
        panels.append(add_caption(picture, f"{name}: {mask.mean():.1%} of pixels"))
    return join_pictures(panels, len(panels))


@dataclass(frozen=True)
class LabelTask:
    """An image file to label. The mask is written to the file `mask`.

    If `figure` is given, a picture like the paper's Figure 4 is written to this file.
    """

    image: Path
    mask: Path
    options: LabelOptions
    figure: Path | None = None
    overwrite: bool = False

    @property
    def outputs(self) -> Outputs:
        """The output files, with a record of the image and the options from which they are made."""
        paths = [self.mask] if self.figure is None else [self.mask, self.figure]
        return Outputs(paths, [self.image], {"label": self.options}, self.overwrite)


def label_file(task: LabelTask) -> dict[str, Any] | str:
    """Write the mask of an image file; return values to report about it, or an error message."""
    try:
        rgb = load_image(task.image)
        label = fuse(luma(rgb), task.options)
    except MissingExtraError:  # every image would fail in the same way
        raise
    except DeepDetectError as error:
        return str(error)
    with task.outputs.writing():
        if task.figure is not None:
            save_picture(draw_label(rgb, label), task.figure)
        save_mask(label.mask, task.mask)
    files = {"image": task.image, "mask": task.mask}
    return {**files, "visibility": label.visibility, "density": label.density}


def join_pictures(panels: Sequence[np.ndarray], columns: int, gap_px: int = 6) -> np.ndarray:
    """Join images of one size in a grid of `columns` columns, with white gaps."""
    shape = -(-len(panels) // columns), columns
    white = {"fill": (255,) * 3, "padding_width": gap_px, "channel_axis": -1}
    joined: np.ndarray = montage(np.stack(panels), grid_shape=shape, **white)
    return joined[gap_px:-gap_px, gap_px:-gap_px]
