"""The nine classical detectors that make labels: a function for each, and the table `DETECTORS`.

To add a detector, write a function that takes an (H, W) uint8 grey image and settings and returns
an (H, W) bool mask. Add it to `DETECTORS`. For each setting, give the value for normal images (the
paper's value, if there is one) and the allowed range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from deepdetect._shared.errors import OptionError, unknown_name
from deepdetect._shared.opencv import cv2

from .factories import opencv_factory

Value = bool | int | float
Settings = Mapping[str, Any]
Range = tuple[float, float] | range
"""Allowed values of a setting: a tuple (smallest, largest), or a range of all allowed integers."""

AGAST_OAST_9_16 = 3
"""The value of `AgastFeatureDetector::OAST_9_16`, which some OpenCV versions do not export."""

# Outside these ranges, OpenCV crashes, runs for minutes, wraps values modulo 256, or fails.
GRAY_LEVELS = (0, 255)
BLOCK_SIZES = (1, 255)
KERNEL_SIZES = range(1, 32, 2)
CANNY_THRESHOLDS = (0, 2040)
"""Allowed range of Canny's thresholds: the values of |dx| + |dy| (3x3 Sobel) of 8-bit images."""


@dataclass(frozen=True, eq=False)
class LabelDetector:
    """A classical detector.

    Attributes:
        kind: what the detector marks: keypoints or edges (two masks in the paper's Figure 4).
        function: function that takes an (H, W) uint8 grey image and all settings, and returns an
            (H, W) bool mask.
        settings: for each setting, its value for normal images and its allowed range. The range is
            None for a bool.
        low_visibility: the settings whose values differ for images of low visibility.
    """

    kind: Literal["keypoint", "edge"]
    function: Callable[[np.ndarray, Settings], np.ndarray]
    settings: Mapping[str, tuple[Value, Range | None]]
    low_visibility: Mapping[str, Value] = field(default_factory=dict)

    @property
    def defaults(self) -> dict[str, Value]:
        """The value of each setting for normal images, by name."""
        return {name: value for name, (value, _) in self.settings.items()}

    def mask(self, gray: np.ndarray, **settings: Value) -> np.ndarray:
        """Return the mask, (H, W) bool, of an (H, W) uint8 image; `settings` replace defaults."""
        return self.function(gray, {**self.defaults, **settings})


def pixels_mask(shape: tuple[int, ...], xy: np.ndarray) -> np.ndarray:
    """Return an (H, W) bool mask of the pixels nearest to points (N, 2), given as x and y.

    `shape` is the image's shape. Points outside the image are ignored. A coordinate midway between
    two pixels is rounded to the even one.
    """
    mask = np.zeros(shape[:2], dtype=bool)
    column, row = np.rint(np.asarray(xy, dtype=np.float64).reshape(-1, 2)).astype(np.intp).T
    inside = (column >= 0) & (column < mask.shape[1]) & (row >= 0) & (row < mask.shape[0])
    mask[row[inside], column[inside]] = True
    return mask


def _marked(gray: np.ndarray, detector: cv2.Feature2D) -> np.ndarray:
    return pixels_mask(gray.shape, cv2.KeyPoint_convert(detector.detect(gray, None)))


def _sift(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect extrema of the difference-of-Gaussians scale space (Lowe, 2004).

    The default `edge_threshold` is so high that practically no extremum on an edge is rejected.
    """
    detector = cv2.SIFT_create(
        nOctaveLayers=settings["octave_layers"],
        contrastThreshold=settings["contrast_threshold"],
        edgeThreshold=settings["edge_threshold"],
        sigma=settings["sigma"],
    )
    return _marked(gray, detector)


def _orb(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect FAST corners on an image pyramid, by default all of them (Rublee et al., 2011)."""
    # The number of levels is limited, because OpenCV fails on levels smaller than a pixel.
    most = 1 + int(math.log(min(gray.shape)) / math.log(settings["scale_factor"]))
    detector = cv2.ORB_create(
        nfeatures=settings["features"],
        scaleFactor=settings["scale_factor"],
        nlevels=min(settings["levels"], most),
        edgeThreshold=settings["edge_threshold"],
        fastThreshold=settings["fast_threshold"],
    )
    return _marked(gray, detector)


@lru_cache(maxsize=8)
def _brisk_detector(threshold: int, octaves: int) -> cv2.Feature2D:
    """Make a BRISK detector, or return the one made for earlier images.

    Making one computes BRISK's sampling pattern. In a dark image, that takes as long as detection.
    """
    return opencv_factory("BRISK_create")(thresh=threshold, octaves=octaves)


def _brisk(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect AGAST corners in a scale space (Leutenegger et al., 2011)."""
    # OpenCV fails on layers smaller than a pixel. Each octave has a second layer, scaled by 2/3.
    most = (2 * min(gray.shape) // 3).bit_length()
    return _marked(gray, _brisk_detector(settings["threshold"], min(settings["octaves"], most)))


def _fast(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect corners by the segment test on a circle of 16 pixels (Rosten and Drummond, 2006)."""
    kind = cv2.FAST_FEATURE_DETECTOR_TYPE_9_16
    create = cv2.FastFeatureDetector_create
    return _marked(gray, create(settings["threshold"], settings["suppression"], kind))


def _agast(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect corners by the segment test with an adaptive decision tree (Mair et al., 2010).

    With equal settings, the mask equals that of FAST, because only the order of comparisons
    differs.
    """
    create = opencv_factory("AgastFeatureDetector_create")
    return _marked(gray, create(settings["threshold"], settings["suppression"], AGAST_OAST_9_16))


def _harris(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect corners by the gradient covariance matrix (Harris and Stephens, 1988).

    By default, the response is dilated by 3x3 pixels, so a corner becomes a blob. Pixels are marked
    if their response exceeds a fraction of the largest response in the image.
    """
    response = cv2.cornerHarris(gray, settings["block_size"], settings["aperture"], settings["k"])
    if settings["dilate"]:
        response = cv2.dilate(response, None)
    return response > settings["relative_threshold"] * max(float(response.max()), 0.0)


def _shi_tomasi(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect corners by the smaller eigenvalue of the gradient covariance (Shi and Tomasi, 1994).

    If `corners` is 0, all corners are kept.
    """
    found = cv2.goodFeaturesToTrack(
        gray,
        maxCorners=settings["corners"],
        qualityLevel=settings["quality_level"],
        minDistance=settings["minimum_distance"],
        blockSize=settings["block_size"],
    )
    return pixels_mask(gray.shape, np.empty((0, 2)) if found is None else found)


def _canny(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect thin edges: gradient maxima with hysteresis (Canny, 1986), without blurring."""
    return cv2.Canny(gray, settings["low_threshold"], settings["high_threshold"]) > 0


def _sobel(gray: np.ndarray, settings: Settings) -> np.ndarray:
    """Detect thick edges: gradients (large Sobel kernel) above a fraction of the largest one."""
    dx = cv2.Sobel(gray, cv2.CV_64F, 1, 0, ksize=settings["kernel_size"])
    dy = cv2.Sobel(gray, cv2.CV_64F, 0, 1, ksize=settings["kernel_size"])
    magnitude = cv2.magnitude(dx, dy)
    return magnitude > settings["relative_threshold"] * float(magnitude.max())


_CORNER_TEST: dict[str, tuple[Value, Range | None]] = {
    "threshold": (13, GRAY_LEVELS),
    "suppression": (False, None),
}

DETECTORS: dict[str, LabelDetector] = {
    "sift": LabelDetector(
        "keypoint",
        _sift,
        {
            "contrast_threshold": (0.04, (0, 1)),
            "edge_threshold": (1000.0, (1, 1e6)),
            "sigma": (1.6, (0.1, 20)),
            "octave_layers": (3, (1, 20)),
        },
    ),
    "orb": LabelDetector(
        "keypoint",
        _orb,
        {
            "features": (1_000_000, (1, 1e7)),
            "scale_factor": (1.2, (1.01, 10)),
            "levels": (7, (1, 32)),
            "edge_threshold": (13, (0, 1000)),
            "fast_threshold": (13, GRAY_LEVELS),
        },
    ),
    "brisk": LabelDetector(
        "keypoint", _brisk, {"threshold": (11, GRAY_LEVELS), "octaves": (3, (0, 16))}
    ),
    "fast": LabelDetector("keypoint", _fast, _CORNER_TEST, {"threshold": 1}),
    "agast": LabelDetector("keypoint", _agast, _CORNER_TEST, {"threshold": 1}),
    "harris": LabelDetector(
        "keypoint",
        _harris,
        {
            "block_size": (3, BLOCK_SIZES),
            "aperture": (5, KERNEL_SIZES),
            "k": (0.001, (0, 1)),
            "relative_threshold": (0.001, (0, 1)),
            "dilate": (True, None),
        },
    ),
    "shi-tomasi": LabelDetector(
        "keypoint",
        _shi_tomasi,
        {
            "corners": (0, (0, 1e7)),
            "quality_level": (0.01, (1e-6, 1)),
            "minimum_distance": (1.0, (0, 1000)),
            "block_size": (2, BLOCK_SIZES),
        },
    ),
    "canny": LabelDetector(
        "edge",
        _canny,
        {
            "low_threshold": (150.0, CANNY_THRESHOLDS),
            "high_threshold": (250.0, CANNY_THRESHOLDS),
        },
    ),
    "sobel": LabelDetector(
        "edge",
        _sobel,
        {"kernel_size": (11, KERNEL_SIZES), "relative_threshold": (0.1, (0, 1))},
        {"relative_threshold": 0.5},
    ),
}

DETECTOR_NAMES: tuple[str, ...] = tuple(DETECTORS)


def select_detectors(names: Iterable[str]) -> tuple[str, ...]:
    """Check detector names, and return them in the order of `DETECTORS`."""
    wanted = set(names)
    for name in sorted(wanted - DETECTORS.keys()):
        raise unknown_name("label detector", name, DETECTOR_NAMES)
    if not wanted:
        raise OptionError(f"no label detector was chosen: name some of {', '.join(DETECTOR_NAMES)}")
    return tuple(name for name in DETECTOR_NAMES if name in wanted)
