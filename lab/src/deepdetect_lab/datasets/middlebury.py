"""Load rectified stereo pairs with ground truth: Middlebury 2003 to 2014 (Scharstein and Szeliski).

A scene is a folder with left.png, right.png, disparity.png (of the left view) and calib.json, which
says how grey values are converted to disparities in pixels::

    {"ground_truth": {"file": "disparity.png", "value_per_pixel": 4.0,
                      "resolution_factor": 1.0, "unknown": 0}}

The disparity in pixels of the full-size image is the grey value divided by value_per_pixel. The
resolution_factor is the width of the disparity map divided by the width of the image.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from skimage import data

from deepdetect._shared.errors import ImageError, MissingImageError
from deepdetect.geometry.camera import Calibration
from deepdetect.io.image import load_image
from deepdetect.io.image_file import open_image


@dataclass(frozen=True, eq=False)
class StereoPair:
    """Two rectified views. The left pixel (x, y) matches the right pixel (x - disparity, y).

    Attributes:
        name: the scene's name.
        left, right: (H, W, 3) uint8 RGB.
        disparity: (H, W) float32 true disparity of the left view in pixels, NaN if unknown.
    """

    name: str
    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray


@dataclass(frozen=True, eq=False)
class CalibratedStereoPair(StereoPair):
    """A rectified pair with the calibration of its cameras."""

    calibration: Calibration


def load_middlebury(folder: str | Path) -> StereoPair:
    """Load a scene and its true disparity map, which is upscaled to the size of the images."""
    root, left, right = _load_views(folder)
    path = root / "calib.json"
    try:
        truth = json.loads(path.read_bytes())["ground_truth"]
        value, unknown = float(truth["value_per_pixel"]), float(truth["unknown"])
        file = root / truth["file"]
    except OSError as error:
        raise ImageError(f"{path} cannot be read ({error.strerror}): check the path") from None
    except (ValueError, OverflowError, RecursionError, KeyError, TypeError) as error:
        raise ImageError(
            f"{path} does not say how the ground truth is stored ({error}): take a scene that has "
            "ground truth"
        ) from None
    with open_image(file) as image:
        stored, is_gray = np.asarray(image), image.mode == "L" or image.mode.startswith("I")
    if not is_gray or not value > 0:
        raise ImageError(
            f"the ground truth {file} must be a grey image with a value_per_pixel above 0"
        )
    disparity = np.where(stored == unknown, np.nan, stored / value).astype(np.float32)
    size = (left.shape[1], left.shape[0])
    disparity = np.asarray(Image.fromarray(disparity).resize(size, Image.Resampling.NEAREST))
    return StereoPair(root.name, left, right, disparity)


def load_calibrated_pair(folder: str | Path) -> CalibratedStereoPair:
    """Load the images and calib.json of a scene, but no ground truth: the disparity is NaN."""
    root, left, right = _load_views(folder)
    size = (left.shape[1], left.shape[0])
    calibration = Calibration.load(root / "calib.json", size)
    unknown = np.full(left.shape[:2], np.nan, np.float32)
    return CalibratedStereoPair(root.name, left, right, unknown, calibration)


def load_motorcycle() -> StereoPair:
    """Load the Motorcycle pair of Middlebury 2014 (741x500) and the true disparity.

    The pair is part of the scikit-image wheel, so nothing is downloaded.
    """
    left, right, disparity = data.stereo_motorcycle()
    disparity = np.asarray(disparity, np.float32).squeeze()
    unknown = ~np.isfinite(disparity)
    return StereoPair("motorcycle", left, right, np.where(unknown, np.nan, disparity))


def _load_views(folder: str | Path) -> tuple[Path, np.ndarray, np.ndarray]:
    root = Path(folder).resolve()
    if not root.is_dir():
        raise MissingImageError(f"there is no folder {folder}: name the folder of a stereo scene")
    left, right = load_image(root / "left.png"), load_image(root / "right.png")
    if left.shape != right.shape:
        raise ImageError(f"left.png and right.png in {root} differ in size: take a rectified pair")
    return root, left, right
