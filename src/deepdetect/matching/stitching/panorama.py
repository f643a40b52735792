"""Stitch images to a panorama."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from ..._shared.alpha import continued
from ..._shared.errors import OptionError, check_name
from ..._shared.image_array import Channels, from_16_bits, to_8_bits
from ..._shared.machine import limited_threads
from ..._shared.options import check_ranges, suggest_keywords
from ..._shared.progress import StageTimer
from ..._shared.value_range import ValueRange
from ...detector.detector import AnyDetector, DeepDetect
from ...geometry.frames import with_flat_parts
from ...geometry.images import downscale
from ...geometry.transforms import scaled_homography, translation_matrix
from ...io.image import load_pixels, luma, one_range
from ...io.image_file import file_name, is_path, read_with
from ...io.projection import require_pinhole
from ..overlay import find_overlay, tell_still
from .bundle_adjustment import RotatingCamera, level_cameras
from .canvas import Canvas, least_distorted, plan_curved, plan_plane
from .compositing import composite, crop_box
from .registration import JointRegistration, register_images

Projection = Literal["plane", "cylindrical", "spherical"]
PROJECTIONS = get_args(Projection)


@suggest_keywords
@dataclass(frozen=True)
class StitchingOptions:
    """Scale, size limit and registration size of a panorama.

    Attributes:
        scale: panorama pixels per image pixel at the centre of the reference image.
        max_canvas_megapixels: size limit of the panorama; a pixel takes 22 to 56 bytes of memory.
        registration_side: longer side in pixels to which images are reduced for registration.

    Raises:
        OptionError: a value is out of its range.
    """

    scale: float = 1.0
    max_canvas_megapixels: float = 50.0
    registration_side: int = 640

    def __post_init__(self) -> None:
        sides = {"registration_side": (100, 1200)}  # larger images give no better homographies
        check_ranges(self, positive=("scale", "max_canvas_megapixels"), between=sides)


@dataclass(frozen=True, eq=False, repr=False)
class Panorama:
    """A stitched panorama.

    Attributes:
        image: (H, W, 3) RGB, black outside of all images; uint16 if an image has more than 8 bits,
            otherwise uint8. If all images are uint16, it keeps their values.
        valid: (H, W) bool, true where an image is.
        homographies: (3, 3) homographies by image number, in the order in which images were
            connected. For a flat panorama they map to `image`, otherwise to the reference image.
        reference: index of the unwarped image, or of the middle one of a curved panorama.
        unregistered: by image number, the reason why an image is not in the panorama.
        matches: number of dense matches of each registered pair.
        residual_px: RMS difference between each pair's own homography and the panorama's, at
            matched keypoints, in pixels of the images reduced for registration; 0 for a flat
            panorama without closed loops.
        gains: brightness factor of each image.
        seconds: time of each stage, by its name.
        parallax: displacement along the seam in panorama pixels, by the numbers of both images, for
            pairs where it is visible because the camera moved between them.
        closed: whether the panorama shows 360 degrees, and its right border continues at the left.
        value_range: the values of black and white in `image`, if it is uint16.
        left_out: share of each image that stands still in all, drawn where none shows the scene.
    """

    image: np.ndarray
    valid: np.ndarray
    homographies: dict[int, np.ndarray]
    reference: int
    unregistered: dict[int, str]
    matches: dict[tuple[int, int], int]
    residual_px: float
    gains: dict[int, float]
    seconds: dict[str, float]
    parallax: dict[tuple[int, int], float]
    closed: bool
    value_range: ValueRange = (0, 65535)
    left_out: float = 0.0

    def __repr__(self) -> str:
        height, width = self.valid.shape
        return (
            f"Panorama({width}x{height}, {len(self.homographies)} images, "
            f"unregistered={self.unregistered}, residual_px={self.residual_px:.3f})"
        )


def stages_of(count: int) -> list[str]:
    """Return the names of the stages that `stitch` reports for `count` images, in order.

    "keypoints" is reported once for each image, and "overlaps" once for each pair of images.
    """
    each = ["keypoints"] * count + ["overlaps"] * (count * (count - 1) // 2)
    return ["reading", *each, "registration", "compositing"]


@suggest_keywords
@limited_threads()
def stitch(
    images: Sequence[Any],
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    projection: Projection = "plane",
    crop: bool = False,
    reference: int | None = None,
    force: bool = False,
    seed: int = 0,
    options: StitchingOptions = StitchingOptions(),
    progress: Callable[[str], object] | None = None,
) -> Panorama:
    """Stitch images taken from one place, or of a plane, into a panorama.

    Pairs are registered by guided matching at reduced size, and all homographies are refined
    jointly. The brightness of the images is equalised, and they are blended on one canvas along
    seams where they differ least. A flat canvas shows less than 180 degrees, in practice 100 to
    120; a cylinder or a sphere shows up to 360.

    Args:
        images: two or more images in any order, in any form that `load_image` accepts. Paths are
            loaded one at a time, so that only one full-size image is in memory.
        detector: a `DeepDetect` or a `PointDetector`, or any object with a method `heatmap` or
            `detect` like theirs. With heat maps, sparse keypoints find overlaps and dense keypoints
            confirm them; otherwise the points do both. Default `DeepDetect()`.
        channels: order of the colour channels in images that are arrays, as in `load_image`.
        projection: "plane" keeps lines straight; "cylindrical" and "spherical" need cameras that
            only rotated, and level the horizon.
        crop: crop the panorama to the largest rectangle without black areas.
        reference: index of the image that a flat panorama leaves unwarped, or of the middle image
            of a curved one; None chooses the image that warps the others least.
        force: make the panorama even if its pairs contradict each other; a warning then says so.
        seed: seed of all random choices.
        options: scale, size limit and registration size of the panorama.
        progress: called with the name of each stage (`stages_of`) when it ends.

    Returns:
        The panorama of all images that could be connected.

    Raises:
        ImageError: an image cannot be read or is unsuitable.
        OptionError: an option is out of its range, there are fewer than two images, or the
            panorama would be too large.
        RegistrationError: no two images overlap, an image is too oblique to the reference for a
            flat panorama, or the images contradict each other.

    Example:
        >>> from deepdetect import PointDetector
        >>> import cv2
        >>> rng = np.random.default_rng(0)
        >>> scene = cv2.GaussianBlur(rng.integers(0, 256, (160, 240)).astype(np.uint8), (0, 0), 2)
        >>> scene = cv2.normalize(scene, None, 0, 255, cv2.NORM_MINMAX)
        >>> panorama = stitch([scene[:, :160], scene[:, 80:]], PointDetector())
        >>> panorama.image.shape
        (160, 240, 3)
    """
    check_name("projection", projection, PROJECTIONS)
    several = isinstance(images, Sequence) or getattr(images, "ndim", 0) == 4
    if not several or len(images) < 2:
        raise OptionError("a panorama needs at least two images: give more images")
    if reference is not None:
        check_name("reference", reference, range(len(images)))
        reference = int(reference)
    names = [file_name(one) if is_path(one) else f"images[{k}]" for k, one in enumerate(images)]
    timer = StageTimer(progress)
    with one_range(images, channels) as reading:
        pass
    with timer.stage("reading"), read_with(reading):
        small, sizes, deep = _reduced(images, channels, options.registration_side)
    with timer.stage("registration"):
        views = [rgb for rgb, _ in small.values()]
        still = find_overlay([luma(rgb) for rgb in views], seed, moves=True)
        if still.any():
            still = with_flat_parts(still, [rgb[:, :, :3] for rgb in views])
            views = [
                np.dstack([r[:, :, :3], ~still * r[:, :, 3:].min(2, initial=255)]) for r in views
            ]
        tell_still(left_out := float(still.mean()))
        registration = register_images(
            views,
            DeepDetect() if detector is None else detector,
            reference=reference,
            turning=projection != "plane",
            force=force,
            seed=seed,
            progress=progress,
            names=names,
        )
    scales = {number: scale for number, (_, scale) in small.items()}
    canvas, homographies, reference = _plan(
        registration, scales, sizes, projection, reference, options.scale, names
    )
    canvas.check_size(options.max_canvas_megapixels)
    with timer.stage("compositing"), read_with(reading):
        panorama, valid, gains, parallax = composite(
            lambda number: continued(load_pixels(images[number], channels, deep=True)),
            small,
            canvas,
            still,
        )
        values = (0, 65535) if not deep or reading.deep_range is None else reading.deep_range
        if deep:
            panorama = np.where(valid[..., None], from_16_bits(panorama, values), 0)
        if crop:
            left, top, right, bottom = crop_box(valid, canvas.closed)
            part = (slice(top, bottom), slice(left, right))
            panorama, valid = panorama[part].copy(), valid[part].copy()
            if projection == "plane":
                shift = translation_matrix(-left, -top)
                homographies = {n: shift @ matrix for n, matrix in homographies.items()}
    numbers = registration.unregistered, registration.matches, registration.residual_px
    found = panorama, valid, homographies, reference, *numbers, gains, timer.seconds, parallax
    return Panorama(*found, canvas.closed, values, left_out)


def _reduced(
    images: Sequence[Any], channels: Channels, side: int
) -> tuple[dict[int, tuple[np.ndarray, float]], dict[int, tuple[int, int]], bool]:
    """Return images reduced to a longer side, with scales; full sizes; whether all have 16 bits."""
    small, sizes, deep = {}, {}, True
    for number, image in enumerate(images):
        rgb = continued(load_pixels(image, channels, deep=True))
        deep &= rgb.dtype == np.uint16
        require_pinhole(image, to_8_bits(rgb)[:, :, :3], name=f"images[{number}]")
        sizes[number] = (rgb.shape[1], rgb.shape[0])
        small[number] = downscale(to_8_bits(rgb), side)
    return small, sizes, deep


def _plan(
    registration: JointRegistration,
    scales: dict[int, float],
    sizes: dict[int, tuple[int, int]],
    projection: Projection,
    reference: int | None,
    scale: float,
    names: Sequence[str],
) -> tuple[Canvas, dict[int, np.ndarray], int]:
    """Return the canvas, the homographies of the panorama, and the index of the reference image.

    `scales` are the factors by which images were reduced for registration, and `sizes` their full
    (width, height), by image number.
    """
    if projection == "plane" or registration.cameras is None:
        homographies = {
            number: scaled_homography(matrix, 1 / scales[number], 1)
            for number, matrix in registration.homographies.items()
        }
        if reference is None:
            reference = least_distorted(sizes, homographies)
        return *plan_plane(sizes, homographies, reference, scale, names), reference
    if reference is None:
        ahead = {number: one.rotation[:, 2] for number, one in registration.cameras.items()}
        middle = np.sum(list(ahead.values()), axis=0)
        reference = max(ahead, key=lambda number: float(ahead[number] @ middle))
    cameras = {
        number: RotatingCamera(one.focal_px / scales[number], one.rotation)
        for number, one in level_cameras(registration.cameras, reference).items()
    }
    rays = {number: one.to_common(sizes[number]) for number, one in cameras.items()}
    homographies = {n: np.linalg.inv(rays[reference]) @ ray for n, ray in rays.items()}
    return plan_curved(projection, sizes, cameras, reference, scale), homographies, reference
