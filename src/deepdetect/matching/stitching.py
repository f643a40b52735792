"""Panoramas of overlapping photographs, with OpenCV's cameras, seams and blender."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from .._shared.errors import DeepDetectError, OptionError
from ..io.image import load_image

REASONS = {
    cv2.Stitcher_ERR_NEED_MORE_IMGS: "they do not overlap enough",
    cv2.Stitcher_ERR_HOMOGRAPHY_EST_FAIL: "no homography fits them",
    cv2.Stitcher_ERR_CAMERA_PARAMS_ADJUST_FAIL: "they were not taken from one place",
}


@dataclass(frozen=True, eq=False)
class Panorama:
    """Photographs put together.

    Attributes:
        picture: (H, W, 3) uint8 RGB, black outside.
        used: numbers of the photographs that it is made of; the others could not be connected.
    """

    picture: np.ndarray
    used: tuple[int, ...]


def stitch(images: Sequence[Any]) -> Panorama:
    """Make a panorama.

    OpenCV's stitcher: its own few features for the cameras (a panorama needs no dense ones),
    bundle adjustment, exposure, seams and a multi-band blender.

    Args:
        images: two or more photographs from one place, in any order.

    Returns:
        The panorama, of all photographs that could be connected.

    Raises:
        OptionError: there are fewer than two images.
        DeepDetectError: they do not make a panorama.
    """
    if len(images) < 2:
        raise OptionError("a panorama needs two photographs or more")
    bgr = [cv2.cvtColor(load_image(image), cv2.COLOR_RGB2BGR) for image in images]
    cv2.setRNGSeed(0)
    stitcher = cv2.Stitcher.create(cv2.Stitcher_PANORAMA)
    try:
        status, panorama = stitcher.stitch(bgr)
    except cv2.error as error:
        # Mostly too little memory: cameras that are estimated badly ask for a huge canvas.
        raise DeepDetectError(
            f"these {len(images)} photographs make no panorama: OpenCV's stitcher failed "
            f"({' '.join(str(error.err or error).split())}): leave some out, or make them smaller"
        ) from error
    if status != cv2.Stitcher_OK:
        reason = REASONS.get(status, "OpenCV's stitcher failed")
        raise DeepDetectError(f"these {len(images)} photographs make no panorama: {reason}")
    used = tuple(sorted(int(number) for number in np.ravel(stitcher.component())))
    return Panorama(cv2.cvtColor(panorama, cv2.COLOR_BGR2RGB), used)
