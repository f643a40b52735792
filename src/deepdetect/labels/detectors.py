"""The nine label detectors: for each its settings and its mask, and the table of all of them.

To add a detector, write a frozen dataclass of settings and a function from a grey image and these
settings to a boolean mask, and add a line to `DETECTORS`. All images are (H, W) uint8 luma, all
masks (H, W) bool.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from .._shared.errors import OptionError, unknown_name
from .._shared.opencv import cv2, opencv_factory
from .._shared.options import check_ranges

Limits = dict[str, tuple[float, float]]

AGAST_OAST_9_16 = 3
"""`AgastFeatureDetector::OAST_9_16`; not every OpenCV exports it to Python."""

# Beyond the ranges of the settings OpenCV ends the process, runs for minutes, takes another number
# (modulo 256), or raises an error.
GRAY_LEVELS = (0, 255)
"""Range of differences of grey levels."""

BLOCK_SIZES = (1, 255)
"""Range of the widths of windows, in pixels."""

KERNEL_SIZES = (1, 31)
"""Range of the widths of Sobel filters, in pixels."""

MAX_CANNY_THRESHOLD = 2040
"""Largest sum of both gradients of the 3x3 Sobel filter, in grey levels."""


def pixels_mask(shape: tuple[int, ...], xy: np.ndarray) -> np.ndarray:
    """Mark the pixel nearest to each point, halves rounded to even.

    Args:
        shape: (height, width) of the mask.
        xy: (N, 2) float points, x right and y down, centre of the first pixel (0, 0).

    Returns:
        (height, width) bool mask. Points outside the image are left out.

    Example:
        >>> pixels_mask((1, 3), np.array([[0.5, 0.0], [1.5, 0.0]])).tolist()
        [[True, False, True]]
    """
    mask = np.zeros(shape[:2], dtype=bool)
    column, row = np.rint(np.asarray(xy, dtype=np.float64).reshape(-1, 2)).astype(np.intp).T
    inside = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
    mask[row[inside], column[inside]] = True
    return mask


def keypoints_mask(gray: np.ndarray, keypoints: Sequence[cv2.KeyPoint]) -> np.ndarray:
    """Mark the pixel of each OpenCV keypoint (see `pixels_mask`)."""
    xy = cv2.KeyPoint_convert(keypoints) if len(keypoints) else np.empty((0, 2))
    return pixels_mask(gray.shape, xy)


@dataclass(frozen=True)
class SiftSettings:
    """Settings of `cv2.SIFT_create`; the edge test is practically switched off."""

    contrast_threshold: float = 0.04
    edge_threshold: float = 1000.0
    sigma: float = 1.6
    octave_layers: int = 3

    def __post_init__(self) -> None:
        limits: Limits = {"contrast_threshold": (0, 1), "edge_threshold": (1, 1e6)}
        limits |= {"sigma": (0.1, 20), "octave_layers": (1, 20)}
        check_ranges(self, between=limits)


def sift_mask(gray: np.ndarray, settings: SiftSettings) -> np.ndarray:
    """Mark SIFT keypoints: extrema of the difference-of-Gaussians scale space (Lowe, 2004)."""
    detector = cv2.SIFT_create(
        nOctaveLayers=settings.octave_layers,
        contrastThreshold=settings.contrast_threshold,
        edgeThreshold=settings.edge_threshold,
        sigma=settings.sigma,
    )
    return keypoints_mask(gray, detector.detect(gray, None))


@dataclass(frozen=True)
class OrbSettings:
    """Settings of `cv2.ORB_create`; `features` is so large that nothing is cut off."""

    features: int = 1_000_000
    scale_factor: float = 1.2
    levels: int = 7
    edge_threshold: int = 13
    fast_threshold: int = 13

    def __post_init__(self) -> None:
        limits: Limits = {"features": (1, 1e7), "scale_factor": (1.01, 10), "levels": (1, 32)}
        limits |= {"edge_threshold": (0, 1000), "fast_threshold": GRAY_LEVELS}
        check_ranges(self, between=limits)


def orb_mask(gray: np.ndarray, settings: OrbSettings) -> np.ndarray:
    """Mark ORB keypoints: FAST corners on an image pyramid (Rublee et al., 2011)."""
    # OpenCV refuses levels of less than a pixel.
    most = 1 + int(math.log(min(gray.shape)) / math.log(settings.scale_factor))
    detector = cv2.ORB_create(
        nfeatures=settings.features,
        scaleFactor=settings.scale_factor,
        nlevels=min(settings.levels, most),
        edgeThreshold=settings.edge_threshold,
        fastThreshold=settings.fast_threshold,
    )
    return keypoints_mask(gray, detector.detect(gray, None))


@dataclass(frozen=True)
class BriskSettings:
    """Settings of `cv2.BRISK_create`."""

    threshold: int = 11
    octaves: int = 3

    def __post_init__(self) -> None:
        check_ranges(self, between={"threshold": GRAY_LEVELS, "octaves": (0, 16)})


@lru_cache(maxsize=8)
def _brisk(settings: BriskSettings) -> cv2.Feature2D:
    """Make a BRISK detector once: its sampling pattern costs as much as a dark image."""
    return opencv_factory("BRISK_create")(thresh=settings.threshold, octaves=settings.octaves)


def brisk_mask(gray: np.ndarray, settings: BriskSettings) -> np.ndarray:
    """Mark BRISK keypoints: AGAST corners in a scale space (Leutenegger et al., 2011)."""
    # OpenCV refuses octaves of less than a pixel; in each, a layer has 2/3 of the size.
    most = (2 * min(gray.shape) // 3).bit_length()
    settings = replace(settings, octaves=min(settings.octaves, most))
    return keypoints_mask(gray, _brisk(settings).detect(gray, None))


@dataclass(frozen=True)
class FastSettings:
    """Settings of `cv2.FastFeatureDetector_create`, type 9-16."""

    threshold: int = 13
    suppression: bool = False

    def __post_init__(self) -> None:
        check_ranges(self, between={"threshold": GRAY_LEVELS})


def fast_mask(gray: np.ndarray, settings: FastSettings) -> np.ndarray:
    """Mark FAST corners: the segment test on a circle of 16 pixels (Rosten and Drummond, 2006)."""
    detector = cv2.FastFeatureDetector_create(
        settings.threshold, settings.suppression, cv2.FAST_FEATURE_DETECTOR_TYPE_9_16
    )
    return keypoints_mask(gray, detector.detect(gray, None))


@dataclass(frozen=True)
class AgastSettings:
    """Settings of `cv2.AgastFeatureDetector_create`, type OAST 9-16."""

    threshold: int = 13
    suppression: bool = False

    def __post_init__(self) -> None:
        check_ranges(self, between={"threshold": GRAY_LEVELS})


def agast_mask(gray: np.ndarray, settings: AgastSettings) -> np.ndarray:
    """Mark AGAST corners: the segment test with an adaptive decision tree (Mair et al., 2010).

    With equal settings the mask is that of FAST: both test the same circle and differ only in
    the order of the comparisons.
    """
    create = opencv_factory("AgastFeatureDetector_create")
    detector = create(settings.threshold, settings.suppression, AGAST_OAST_9_16)
    return keypoints_mask(gray, detector.detect(gray, None))


@dataclass(frozen=True)
class HarrisSettings:
    """Settings of `cv2.cornerHarris`; the threshold is relative to the largest response."""

    block_size: int = 3
    aperture: int = 5
    k: float = 0.001
    relative_threshold: float = 0.001
    dilate: bool = True

    def __post_init__(self) -> None:
        check_ranges(
            self,
            fractions=("k", "relative_threshold"),
            odd=("aperture",),
            between={"block_size": BLOCK_SIZES, "aperture": KERNEL_SIZES},
        )


def harris_mask(gray: np.ndarray, settings: HarrisSettings) -> np.ndarray:
    """Mark corners of the gradient covariance (Harris and Stephens, 1988).

    The response is dilated by 3x3 before it is thresholded, which makes blobs.
    """
    response = cv2.cornerHarris(gray, settings.block_size, settings.aperture, settings.k)
    if settings.dilate:
        response = cv2.dilate(response, None)
    return response > settings.relative_threshold * max(float(response.max()), 0.0)


@dataclass(frozen=True)
class ShiTomasiSettings:
    """Settings of `cv2.goodFeaturesToTrack`; `corners` 0 means all of them."""

    corners: int = 0
    quality_level: float = 0.01
    minimum_distance: float = 1.0
    block_size: int = 2

    def __post_init__(self) -> None:
        limits: Limits = {"corners": (0, 1e7), "quality_level": (1e-6, 1)}
        limits |= {"minimum_distance": (0, 1000), "block_size": BLOCK_SIZES}
        check_ranges(self, between=limits)


def shi_tomasi_mask(gray: np.ndarray, settings: ShiTomasiSettings) -> np.ndarray:
    """Mark corners by the smaller eigenvalue of the gradient covariance (Shi and Tomasi, 1994)."""
    corners = cv2.goodFeaturesToTrack(
        gray,
        maxCorners=settings.corners,
        qualityLevel=settings.quality_level,
        minDistance=settings.minimum_distance,
        blockSize=settings.block_size,
    )
    return pixels_mask(gray.shape, np.empty((0, 2)) if corners is None else corners)


@dataclass(frozen=True)
class CannySettings:
    """The two thresholds of `cv2.Canny`; the image is not blurred first."""

    low_threshold: float = 150.0
    high_threshold: float = 250.0

    def __post_init__(self) -> None:
        limits = dict.fromkeys(("low_threshold", "high_threshold"), (0, MAX_CANNY_THRESHOLD))
        check_ranges(self, between=limits)


def canny_mask(gray: np.ndarray, settings: CannySettings) -> np.ndarray:
    """Mark thin edges: gradient maxima with hysteresis (Canny, 1986)."""
    return cv2.Canny(gray, settings.low_threshold, settings.high_threshold) > 0


@dataclass(frozen=True)
class SobelSettings:
    """Width of the derivative filter; the threshold is relative to the largest gradient."""

    kernel_size: int = 11
    relative_threshold: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(
            self,
            fractions=("relative_threshold",),
            odd=("kernel_size",),
            between={"kernel_size": KERNEL_SIZES},
        )


def sobel_mask(gray: np.ndarray, settings: SobelSettings) -> np.ndarray:
    """Mark thick edges: a large gradient by a wide derivative filter."""
    dx = cv2.Sobel(gray, cv2.CV_64F, 1, 0, ksize=settings.kernel_size)
    dy = cv2.Sobel(gray, cv2.CV_64F, 0, 1, ksize=settings.kernel_size)
    magnitude = cv2.magnitude(dx, dy)
    return magnitude > settings.relative_threshold * float(magnitude.max())


@dataclass(frozen=True)
class LabelDetector:
    """A classical detector, with its settings for normal and for low-visibility images.

    Attributes:
        name: the name users choose it by.
        kind: whether it marks keypoints or edges (the two halves of the paper's Figure 4).
        mask: function from a (H, W) uint8 grey image and settings to a (H, W) bool mask.
        normal: settings for a normal image.
        low_visibility: settings for an image with few grey levels.
    """

    name: str
    kind: Literal["keypoint", "edge"]
    mask: Callable[[np.ndarray, Any], np.ndarray]
    normal: Any
    low_visibility: Any


DETECTORS: tuple[LabelDetector, ...] = (
    LabelDetector("sift", "keypoint", sift_mask, SiftSettings(), SiftSettings()),
    LabelDetector("orb", "keypoint", orb_mask, OrbSettings(), OrbSettings()),
    LabelDetector("brisk", "keypoint", brisk_mask, BriskSettings(), BriskSettings()),
    LabelDetector("fast", "keypoint", fast_mask, FastSettings(), FastSettings(threshold=1)),
    LabelDetector("agast", "keypoint", agast_mask, AgastSettings(), AgastSettings(threshold=1)),
    LabelDetector("harris", "keypoint", harris_mask, HarrisSettings(), HarrisSettings()),
    LabelDetector(
        "shi-tomasi", "keypoint", shi_tomasi_mask, ShiTomasiSettings(), ShiTomasiSettings()
    ),
    LabelDetector("canny", "edge", canny_mask, CannySettings(), CannySettings()),
    LabelDetector(
        "sobel", "edge", sobel_mask, SobelSettings(), SobelSettings(relative_threshold=0.5)
    ),
)


def run_detector(detector: LabelDetector, gray: np.ndarray, settings: Any) -> np.ndarray:
    """Return what a detector marks in a (H, W) uint8 grey image, (H, W) bool.

    Raises:
        OptionError: OpenCV refuses the settings for this image.
    """
    try:
        return detector.mask(gray, settings)
    except (cv2.error, ValueError, OverflowError) as error:
        reason = (str(error).strip().splitlines() or ["no reason given"])[-1]
        size = f"{gray.shape[1]}x{gray.shape[0]}"
        raise OptionError(
            f"OpenCV refuses {settings} for an image of {size} pixels ({reason}): change them"
        ) from None


DETECTOR_NAMES: tuple[str, ...] = tuple(detector.name for detector in DETECTORS)


def select_detectors(names: Iterable[str]) -> tuple[LabelDetector, ...]:
    """Look up detectors by name, in the order of `DETECTORS`, each once.

    Raises:
        OptionError: a name is unknown (the nearest right one is named), or there is none.

    Example:
        >>> [d.name for d in select_detectors(["sobel", "fast"])]
        ['fast', 'sobel']
    """
    wanted = set()
    for name in names:
        if name not in DETECTOR_NAMES:
            raise unknown_name("label detector", name, DETECTOR_NAMES)
        wanted.add(name)
    if not wanted:
        raise OptionError(
            f"no label detector was chosen: name at least one of {', '.join(DETECTOR_NAMES)}"
        )
    return tuple(detector for detector in DETECTORS if detector.name in wanted)
