"""The nine label detectors: a function for each, and the table of all of them.

To add a detector, write a function from a grey image and keyword parameters to a boolean mask, and
add a line to `DETECTORS`. All images are (H, W) uint8 luma, all masks (H, W) bool. The defaults of
the parameters are the paper's settings of normal images.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np

from .._shared.errors import OptionError, unknown_name
from .._shared.opencv import cv2, opencv_factory

Value = bool | int | float
Range = tuple[float, float] | range
"""Smallest and largest value, or all values."""

AGAST_OAST_9_16 = 3
"""`AgastFeatureDetector::OAST_9_16`; not every OpenCV exports it to Python."""

# Beyond these ranges OpenCV ends the process, runs for minutes, takes another number (modulo 256),
# or raises an error.
GRAY_LEVELS = (0, 255)
"""Range of differences of grey levels."""

BLOCK_SIZES = (1, 255)
"""Range of the widths of windows, in pixels."""

KERNEL_SIZES = range(1, 32, 2)
"""Widths of Sobel filters, in pixels."""

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


def sift_mask(
    gray: np.ndarray,
    contrast_threshold: float = 0.04,
    edge_threshold: float = 1000.0,
    sigma: float = 1.6,
    octave_layers: int = 3,
) -> np.ndarray:
    """Mark SIFT keypoints: extrema of the difference-of-Gaussians scale space (Lowe, 2004).

    The edge test is practically switched off.
    """
    detector = cv2.SIFT_create(
        nOctaveLayers=octave_layers,
        contrastThreshold=contrast_threshold,
        edgeThreshold=edge_threshold,
        sigma=sigma,
    )
    return keypoints_mask(gray, detector.detect(gray, None))


def orb_mask(
    gray: np.ndarray,
    features: int = 1_000_000,
    scale_factor: float = 1.2,
    levels: int = 7,
    edge_threshold: int = 13,
    fast_threshold: int = 13,
) -> np.ndarray:
    """Mark ORB keypoints: FAST corners on an image pyramid (Rublee et al., 2011).

    `features` is so large that nothing is cut off.
    """
    # OpenCV refuses levels of less than a pixel.
    most = 1 + int(math.log(min(gray.shape)) / math.log(scale_factor))
    detector = cv2.ORB_create(
        nfeatures=features,
        scaleFactor=scale_factor,
        nlevels=min(levels, most),
        edgeThreshold=edge_threshold,
        fastThreshold=fast_threshold,
    )
    return keypoints_mask(gray, detector.detect(gray, None))


@lru_cache(maxsize=8)
def _brisk(threshold: int, octaves: int) -> cv2.Feature2D:
    """Make a BRISK detector once: its sampling pattern costs as much as a dark image."""
    return opencv_factory("BRISK_create")(thresh=threshold, octaves=octaves)


def brisk_mask(gray: np.ndarray, threshold: int = 11, octaves: int = 3) -> np.ndarray:
    """Mark BRISK keypoints: AGAST corners in a scale space (Leutenegger et al., 2011)."""
    # OpenCV refuses octaves of less than a pixel; in each, a layer has 2/3 of the size.
    most = (2 * min(gray.shape) // 3).bit_length()
    return keypoints_mask(gray, _brisk(threshold, min(octaves, most)).detect(gray, None))


def fast_mask(gray: np.ndarray, threshold: int = 13, suppression: bool = False) -> np.ndarray:
    """Mark FAST corners: the segment test on a circle of 16 pixels (Rosten and Drummond, 2006)."""
    detector = cv2.FastFeatureDetector_create(
        threshold, suppression, cv2.FAST_FEATURE_DETECTOR_TYPE_9_16
    )
    return keypoints_mask(gray, detector.detect(gray, None))


def agast_mask(gray: np.ndarray, threshold: int = 13, suppression: bool = False) -> np.ndarray:
    """Mark AGAST corners: the segment test with an adaptive decision tree (Mair et al., 2010).

    With equal settings the mask is that of FAST: both test the same circle and differ only in
    the order of the comparisons.
    """
    create = opencv_factory("AgastFeatureDetector_create")
    detector = create(threshold, suppression, AGAST_OAST_9_16)
    return keypoints_mask(gray, detector.detect(gray, None))


def harris_mask(
    gray: np.ndarray,
    block_size: int = 3,
    aperture: int = 5,
    k: float = 0.001,
    relative_threshold: float = 0.001,
    dilate: bool = True,
) -> np.ndarray:
    """Mark corners of the gradient covariance (Harris and Stephens, 1988).

    The response is dilated by 3x3, which makes blobs, before it is compared with a threshold
    relative to the largest response.
    """
    response = cv2.cornerHarris(gray, block_size, aperture, k)
    if dilate:
        response = cv2.dilate(response, None)
    return response > relative_threshold * max(float(response.max()), 0.0)


def shi_tomasi_mask(
    gray: np.ndarray,
    corners: int = 0,
    quality_level: float = 0.01,
    minimum_distance: float = 1.0,
    block_size: int = 2,
) -> np.ndarray:
    """Mark corners by the smaller eigenvalue of the gradient covariance (Shi and Tomasi, 1994).

    0 `corners` are all of them.
    """
    found = cv2.goodFeaturesToTrack(
        gray,
        maxCorners=corners,
        qualityLevel=quality_level,
        minDistance=minimum_distance,
        blockSize=block_size,
    )
    return pixels_mask(gray.shape, np.empty((0, 2)) if found is None else found)


def canny_mask(
    gray: np.ndarray, low_threshold: float = 150.0, high_threshold: float = 250.0
) -> np.ndarray:
    """Mark thin edges: gradient maxima with hysteresis (Canny, 1986), without a blur before."""
    return cv2.Canny(gray, low_threshold, high_threshold) > 0


def sobel_mask(
    gray: np.ndarray, kernel_size: int = 11, relative_threshold: float = 0.1
) -> np.ndarray:
    """Mark thick edges: a gradient by a wide filter, large relative to the largest one."""
    dx = cv2.Sobel(gray, cv2.CV_64F, 1, 0, ksize=kernel_size)
    dy = cv2.Sobel(gray, cv2.CV_64F, 0, 1, ksize=kernel_size)
    magnitude = cv2.magnitude(dx, dy)
    return magnitude > relative_threshold * float(magnitude.max())


@dataclass(frozen=True, eq=False)
class LabelDetector:
    """A classical detector.

    Attributes:
        kind: whether it marks keypoints or edges (the two halves of the paper's Figure 4).
        mask: function from a (H, W) uint8 grey image and keyword parameters to a (H, W) bool mask.
        limits: ranges of the parameters that are numbers.
        low_visibility: parameters of an image with few grey levels that differ from the defaults.
    """

    kind: Literal["keypoint", "edge"]
    mask: Callable[..., np.ndarray]
    limits: Mapping[str, Range]
    low_visibility: Mapping[str, Value] = field(default_factory=dict)

    @property
    def defaults(self) -> dict[str, Value]:
        """The parameters of a normal image."""
        parameters = list(inspect.signature(self.mask).parameters.values())[1:]
        return {parameter.name: parameter.default for parameter in parameters}


DETECTORS: dict[str, LabelDetector] = {
    "sift": LabelDetector(
        "keypoint",
        sift_mask,
        {
            "contrast_threshold": (0, 1),
            "edge_threshold": (1, 1e6),
            "sigma": (0.1, 20),
            "octave_layers": (1, 20),
        },
    ),
    "orb": LabelDetector(
        "keypoint",
        orb_mask,
        {
            "features": (1, 1e7),
            "scale_factor": (1.01, 10),
            "levels": (1, 32),
            "edge_threshold": (0, 1000),
            "fast_threshold": GRAY_LEVELS,
        },
    ),
    "brisk": LabelDetector("keypoint", brisk_mask, {"threshold": GRAY_LEVELS, "octaves": (0, 16)}),
    "fast": LabelDetector("keypoint", fast_mask, {"threshold": GRAY_LEVELS}, {"threshold": 1}),
    "agast": LabelDetector("keypoint", agast_mask, {"threshold": GRAY_LEVELS}, {"threshold": 1}),
    "harris": LabelDetector(
        "keypoint",
        harris_mask,
        {
            "block_size": BLOCK_SIZES,
            "aperture": KERNEL_SIZES,
            "k": (0, 1),
            "relative_threshold": (0, 1),
        },
    ),
    "shi-tomasi": LabelDetector(
        "keypoint",
        shi_tomasi_mask,
        {
            "corners": (0, 1e7),
            "quality_level": (1e-6, 1),
            "minimum_distance": (0, 1000),
            "block_size": BLOCK_SIZES,
        },
    ),
    "canny": LabelDetector(
        "edge",
        canny_mask,
        dict.fromkeys(("low_threshold", "high_threshold"), (0, MAX_CANNY_THRESHOLD)),
    ),
    "sobel": LabelDetector(
        "edge",
        sobel_mask,
        {"kernel_size": KERNEL_SIZES, "relative_threshold": (0, 1)},
        {"relative_threshold": 0.5},
    ),
}

DETECTOR_NAMES: tuple[str, ...] = tuple(DETECTORS)


def run_detector(name: str, gray: np.ndarray, settings: Mapping[str, Value]) -> np.ndarray:
    """Return what a detector marks in a (H, W) uint8 grey image, (H, W) bool.

    Raises:
        OptionError: OpenCV refuses the settings for this image.
    """
    try:
        return DETECTORS[name].mask(gray, **settings)
    except (cv2.error, ValueError, OverflowError) as error:
        reason = (str(error).strip().splitlines() or ["no reason given"])[-1]
        size = f"{gray.shape[1]}x{gray.shape[0]}"
        values = ", ".join(f"{key}={value}" for key, value in settings.items())
        raise OptionError(
            f"OpenCV refuses {name}({values}) for an image of {size} pixels ({reason}): change them"
        ) from None


def select_detectors(names: Iterable[str]) -> tuple[str, ...]:
    """Check names of detectors; return them in the order of `DETECTORS`, each once.

    Raises:
        OptionError: a name is unknown (the nearest right one is named), or there is none.

    Example:
        >>> select_detectors(["sobel", "fast"])
        ('fast', 'sobel')
    """
    wanted = set(names)
    for name in sorted(wanted - DETECTORS.keys()):
        raise unknown_name("label detector", name, DETECTOR_NAMES)
    if not wanted:
        raise OptionError(
            f"no label detector was chosen: name at least one of {', '.join(DETECTOR_NAMES)}"
        )
    return tuple(name for name in DETECTOR_NAMES if name in wanted)
