"""Panoramas: from photographs to one picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..._shared.errors import OptionError
from ..._shared.image_array import Channels
from ..._shared.options import suggest_keywords
from ..._shared.timing import StageTimer
from ...detector.detector import AnyDetector, DeepDetect
from ...geometry.rescaling import downscale, scaled_homography
from ...io.image import load_image
from ..guided import GuidedOptions
from .compositing import composite, least_distorted, plan_canvas
from .joint_registration import register_jointly
from .options import DEFAULTS, StitchingOptions

STAGES = ("reading", "registration", "compositing")
"""Of a panorama."""


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Panorama:
    """Photographs put together.

    Attributes:
        image: (H, W, 3) uint8 RGB, black where no photograph is.
        valid: (H, W) bool, where one is.
        homographies: (3, 3) from each photograph to `image`, by its number; in the order in
            which they were connected.
        reference: number of the photograph that is not distorted.
        left_out: why each other photograph has no part in it, by its number.
        matches: number of dense matches of each pair that was registered.
        residual_px: root mean square of the distances that the homographies of the pairs are
            from those of the panorama, in pixels of the registration; 0 without closed loops.
        gains: factor that the brightness of each photograph was multiplied by.
        seconds: time of each stage.
    """

    image: np.ndarray
    valid: np.ndarray
    homographies: dict[int, np.ndarray]
    reference: int
    left_out: dict[int, str]
    matches: dict[tuple[int, int], int]
    residual_px: float
    gains: dict[int, float]
    seconds: dict[str, float]

    def __repr__(self) -> str:
        height, width = self.valid.shape
        return (
            f"Panorama({width}x{height}, {len(self.homographies)} images, "
            f"left_out={self.left_out}, residual_px={self.residual_px:.3f})"
        )


@suggest_keywords
def stitch(
    images: Sequence[Any],
    *,
    channels: Channels = "rgb",
    detector: AnyDetector | None = None,
    reference: int | None = None,
    scale: float = 1.0,
    max_canvas_megapixels: float = 50.0,
    registration_side: int = 640,
    options: StitchingOptions = DEFAULTS,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
) -> Panorama:
    """Make a flat panorama of photographs from one place, or of a plane.

    Pairs are registered by guided matching at reduced size, jointly refined, and
    drawn onto one canvas with equal brightness, seams where they differ least, and soft borders.
    A flat canvas shows less than 180 degrees, in practice 100 to 120.

    Args:
        images: two or more, in any order; each anything `load_image` takes. Paths are read when
            they are needed, so that only one photograph at its full size is in the memory.
        channels: order of the colours in images that are arrays, as of `load_image`.
        detector: a `DeepDetect`, or anything with its `heatmap` method: SIFT's keypoints find the
            overlaps, dense ones confirm them; or a `PointDetector`, whose points do both. Default
            `DeepDetect()`.
        reference: number of the photograph in whose frame the panorama is; None for the one in
            the middle.
        scale: pixels of the panorama per pixel of the reference.
        max_canvas_megapixels: a larger panorama is refused before it is drawn. It takes 22
            to 47 bytes of memory per pixel.
        registration_side: longer side in pixels to which photographs are reduced for registration.
        options: what counts as an overlap, the joint fit, exposure, seams and blending.
        seed: of all random choices.
        progress: called with the name of each stage (`STAGES`) when it ends.

    Returns:
        The panorama, of all photographs that could be connected.

    Raises:
        ImageError: an image cannot be read or is not fit.
        OptionError: an option is out of its range, there are fewer than two images, or the
            panorama would be too large.
        MissingExtraError: numba is not installed.
        RegistrationError: no two images overlap, or one reaches the horizon of the reference.

    Example:
        >>> from deepdetect.evaluation.baselines.random import RandomDetector
        >>> import cv2
        >>> rng = np.random.default_rng(0)
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (160, 240)).astype(np.uint8), (0, 0), 2)
        >>> scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
        >>> panorama = stitch([scene[:, :160], scene[:, 80:]], detector=RandomDetector())
        >>> panorama.image.shape
        (160, 240, 3)
    """
    _check(images, reference, scale, max_canvas_megapixels, registration_side)
    done = progress or (lambda stage: None)
    timer = StageTimer()
    small: dict[int, tuple[np.ndarray, float]] = {}
    sizes: dict[int, tuple[int, int]] = {}
    with timer.stage("reading"):
        for number, image in enumerate(images):
            rgb = load_image(image, channels=channels)
            sizes[number] = (rgb.shape[1], rgb.shape[0])
            small[number] = downscale(rgb, registration_side)
        del rgb
    done("reading")
    with timer.stage("registration"):
        registration = register_jointly(
            [rgb for rgb, _ in small.values()],
            DeepDetect() if detector is None else detector,
            reference=reference,
            options=options,
            seed=seed,
        )
    done("registration")
    homographies = {
        number: scaled_homography(matrix, 1 / small[number][1], 1)
        for number, matrix in registration.homographies.items()
    }
    frame = least_distorted(sizes, homographies) if reference is None else reference
    canvas = plan_canvas(
        sizes,
        homographies,
        frame,
        scale=scale,
        max_canvas_megapixels=max_canvas_megapixels,
        max_depth_ratio=options.max_depth_ratio,
    )
    with timer.stage("compositing"):
        panorama, valid, gains = composite(
            lambda number: load_image(images[number], channels=channels), small, canvas, options
        )
    done("compositing")
    return Panorama(
        panorama,
        valid,
        canvas.homographies,
        frame,
        registration.left_out,
        registration.matches,
        registration.residual_px,
        gains,
        timer.seconds,
    )


def _check(
    images: Sequence[Any],
    reference: int | None,
    scale: float,
    max_canvas_megapixels: float,
    registration_side: int,
) -> None:
    if len(images) < 2:
        raise OptionError("a panorama needs two photographs or more: give more images")
    if reference is not None and not 0 <= reference < len(images):
        raise OptionError(
            f"`reference` must be the number of an image, from 0 to {len(images) - 1}, "
            f"not {reference}"
        )
    if not (scale > 0 and math.isfinite(scale)):
        raise OptionError(f"`scale` must be above 0, not {scale}")
    if not max_canvas_megapixels > 0:
        raise OptionError(f"`max_canvas_megapixels` must be above 0, not {max_canvas_megapixels}")
    largest = GuidedOptions().initial_geometry.max_side_px
    if not 100 <= registration_side <= largest:
        raise OptionError(
            f"`registration_side` must lie in [100, {largest}] pixels, not {registration_side}"
        )
