"""Source images of a run, their views (size, light, augmentation), and the labels of the views."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from deepdetect._shared.errors import ImageError
from deepdetect._shared.opencv import cv2
from deepdetect._shared.records import file_digest, key
from deepdetect.io.image import find_images, load_image, luma

from ..datasets.scaling import scale_short_side
from ..labels import LabelOptions, fuse
from ..labels.settings import Visibility
from .augmentation import (
    AUGMENTATION_VERSION,
    Darkening,
    augment,
    darken,
    draw_darkening,
    draw_exposure,
)
from .recipe import TrainingOptions


@dataclass(frozen=True)
class View:
    """A view of an image for the network: shorter side in pixels, light and shape.

    `square` is None if the view shows the whole image, "crop" for the central square, and "squash"
    for the image resized to a square. If `augmentation`, a seed, is given, the view instead shows a
    square part of the image with random augmentations.
    """

    short_side: int
    darkening: Darkening | None = None
    square: Literal["crop", "squash"] | None = None
    augmentation: int | None = None

    @property
    def name(self) -> str:
        """Short name for use in file names, unique among the views of an image."""
        light = "normal"
        if self.darkening is not None:
            light = f"b{self.darkening.brightness:.3f}c{self.darkening.contrast:.3f}"
        shape = {None: "", "crop": "c", "squash": "x"}[self.square]
        if self.augmentation is not None:
            shape = f"v{AUGMENTATION_VERSION}-{self.augmentation:08x}"
        return f"{self.short_side}{shape}_{light}"


@dataclass(frozen=True)
class SourceImage:
    """An image for training or validation: its file, a digest of the content, and its views."""

    path: Path
    digest: str
    normal: tuple[View, ...]
    dark: tuple[View, ...]

    @property
    def validation_views(self) -> tuple[View, View]:
        """The view in normal light and the dark view that are used for validation."""
        return self.normal[0], self.dark[0]


def views_of(name: str, options: TrainingOptions) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Return the normal and the dark views of an image: one of each size, then augmented views.

    The seed of the random choices is `name`, the path of the image in its folder.
    """
    generator = np.random.default_rng(zlib.crc32(name.encode()))
    normal = tuple(View(side, None, options.square) for side in options.short_sides)
    dark = tuple(
        View(side, draw_darkening(generator), options.square) for side in options.short_sides
    )
    generator = np.random.default_rng([zlib.crc32(name.encode()), 1])
    side = options.short_sides[0]
    for _ in range(options.augmentations):
        seed = int(generator.integers(2**32))
        normal += (View(side, augmentation=seed),)
        draw = draw_exposure if seed % 2 else draw_darkening
        dark += (View(side, draw(generator), augmentation=seed),)
    return normal, dark


def render(image: object, view: View) -> np.ndarray:
    """Render a view, (H, W, 3) uint8 RGB, of an image in any form that `load_image` accepts."""
    rgb = load_image(image)
    if view.augmentation is not None:
        rgb = augment(rgb, view.short_side, view.augmentation)
    elif view.square != "squash":
        if view.square == "crop":
            side = min(rgb.shape[:2])
            top, left = ((length - side) // 2 for length in rgb.shape[:2])
            rgb = np.ascontiguousarray(rgb[top : top + side, left : left + side])
        rgb = scale_short_side(rgb, view.short_side)
    elif rgb.shape[:2] != (view.short_side, view.short_side):
        size = (view.short_side, view.short_side)
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_CUBIC)
    return rgb if view.darkening is None else darken(rgb, view.darkening)


def label_view(rgb: np.ndarray, view: View, options: LabelOptions) -> np.ndarray:
    """Make the label, (H, W) bool, of a rendered view, (H, W, 3) uint8 RGB.

    Label detectors use the low-visibility settings for a dark view, else the normal settings.
    """
    visibility: Visibility = "normal" if view.darkening is None else "low"
    return fuse(luma(rgb), replace(options, visibility=visibility)).mask


def label_key(options: LabelOptions) -> str:
    """Return a digest of the label settings. A label depends only on these and on the view."""
    names = options.detectors
    return key({n: [options.parameters(n, "normal"), options.parameters(n, "low")] for n in names})


def list_images(
    root: Path, options: TrainingOptions, exclude: Sequence[Path] = (), limit: int | None = None
) -> list[SourceImage]:
    """List the images in a folder, recursively.

    If there are more than `limit` images, checksums of the file names decide which are used.
    """
    paths = find_images(root, exclude)
    if limit is not None and len(paths) > limit:
        chosen = sorted(paths, key=lambda path: (zlib.crc32(path.name.encode()), path))[:limit]
        paths = sorted(chosen)
    return [
        SourceImage(
            path, file_digest(path)[:16], *views_of(path.relative_to(root).as_posix(), options)
        )
        for path in paths
    ]


def train_val_split(
    images: Sequence[SourceImage], val_fraction: float = 0.05
) -> tuple[list[SourceImage], list[SourceImage]]:
    """Split images into training images and about the given fraction of validation images.

    The checksum of an image's file name decides, so that the image stays in its part when other
    images are added.
    """
    training: list[SourceImage] = []
    validation: list[SourceImage] = []
    for image in images:
        # Reversed bits make the split independent of `list_images`, which uses the same checksum.
        draw = int(f"{zlib.crc32(image.path.name.encode()):032b}"[::-1], 2) / 2**32
        (validation if draw < val_fraction else training).append(image)
    if not validation:
        training, validation = training[:-1], training[-1:]
    if not validation or not training:
        raise ImageError(
            "one image is too few to train on: add more, or give a folder for `validation`"
        )
    return training, validation
