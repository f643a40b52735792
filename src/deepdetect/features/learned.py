"""Learned descriptors, which can be rotated without computing them again from the image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from .keypoints import Keypoints
from .matchers import DescriptorMatches

LEARNED: Final = "learned"
LEARNED_FREE: Final = "learned-free"
CROSS_MODAL: Final = "cross-modal"
"""Values of `Keypoints.descriptor_type` for learned descriptors. "learned-free" was trained only on
freely licensed photographs. "cross-modal" is for images of different sensors, in which dark and
bright may be swapped: "learned" descriptors of the edge strength instead of the luma. For your own
weights, the type is "learned-" and the start of the SHA-256 of their file."""

RATIO, LEARNED_RATIO = 0.85, 0.88
RATIOS = {LEARNED: 0.91, CROSS_MODAL: 0.90}
"""Limits of Lowe's ratio test: RATIO for types that are not learned, RATIOS for two learned types,
LEARNED_RATIO for the others. At these limits, unrelated validation photographs (photos/val) get as
many matches as with RootSIFT at 0.85, and synthetic views of one of them a higher precision."""

LENGTH, CONSTANT = 64, 16
"""The first 16 of the 64 numbers of a learned descriptor do not change if the image is rotated."""

FREQUENCIES = np.repeat([1, 2, 3], [12, 8, 4])
"""The last 48 numbers of a descriptor are the real, then the imaginary parts of 24 complex numbers.
A rotation of the image adds the angle times the factor in this array to each number's phase."""

UPRIGHT_DEGREES = 15.0
"""Smaller rotations between images are not undone: the trained networks tolerate them."""

TURNED_KEYPOINTS = 512
"""The rotation between two images is estimated by matching this number of the best keypoints of
each image. Chosen by hand."""

HISTOGRAM_DEGREES, NEAR_DEGREES = 10, 20
"""`common_turn` makes a histogram of angles with bins of width `HISTOGRAM_DEGREES`. It returns the
median of the angles within `NEAR_DEGREES` of the fullest bin. Chosen by hand."""


def is_learned(descriptor_type: str | None) -> bool:
    """Return whether descriptors of this type are learned, with bundled or your own weights."""
    return descriptor_type is not None and descriptor_type.startswith((LEARNED, CROSS_MODAL))


def ratio_limit(descriptor_type: str | None) -> float:
    """Return the default limit of Lowe's ratio test for descriptors of a type."""
    default = LEARNED_RATIO if is_learned(descriptor_type) else RATIO
    return RATIOS.get(str(descriptor_type), default)


def turn_descriptors(descriptors: np.ndarray, degrees: np.ndarray | float) -> np.ndarray:
    """Rotate (N, 64) float32 learned descriptors, as if the image were rotated.

    The angles, (N,) or one for all descriptors, are in degrees from the x axis towards the y axis.
    """
    real = CONSTANT + len(FREQUENCIES)
    once = np.exp(1j * np.radians(np.reshape(degrees, -1))).astype(np.complex64)
    turns = np.stack([once, once**2, once**3], axis=1)[:, FREQUENCIES - 1]
    numbers = (descriptors[:, CONSTANT:real] + 1j * descriptors[:, real:]) * turns
    return np.hstack([descriptors[:, :CONSTANT], numbers.real, numbers.imag])


def match_learned(
    features0: Keypoints,
    features1: Keypoints,
    match: Callable[[np.ndarray, np.ndarray], DescriptorMatches],
) -> tuple[DescriptorMatches, float]:
    """Match learned descriptors; return also the undone rotation between the images, in degrees.

    Descriptors that are rotated to the keypoints' own angles match under any rotation of the image.
    Matches of the best keypoints therefore tell the rotation between the images. Then only this
    common rotation is undone, and all keypoints are matched by upright descriptors. These are more
    distinctive: of 2,048 keypoints on HPatches 570 match correctly, with their own angles 449.
    """
    descriptors0, descriptors1 = features0.descriptors, features1.descriptors
    assert descriptors0 is not None
    assert descriptors1 is not None
    if features0.angles is None or features1.angles is None:
        return match(descriptors0, descriptors1), 0.0
    angles0, angles1 = features0.angles, features1.angles
    own = match(descriptors0[:TURNED_KEYPOINTS], descriptors1[:TURNED_KEYPOINTS])
    turn = common_turn(angles1[own.indices1] - angles0[own.indices0])
    first = turn_descriptors(descriptors0, angles0)
    turned = match(first, turn_descriptors(descriptors1, angles1 - turn))
    if abs((turn + 180) % 360 - 180) < UPRIGHT_DEGREES:
        return turned, turn
    # If few descriptors match, the estimated rotation may be random, so 0 is tried as well.
    upright = match(first, turn_descriptors(descriptors1, angles1))
    return (turned, turn) if len(turned) > len(upright) else (upright, 0.0)


def common_turn(degrees: np.ndarray) -> float:
    """Return the most frequent of (N,) rotation angles, in degrees; 0 if there are none."""
    degrees = degrees % 360
    bins = np.bincount((degrees // HISTOGRAM_DEGREES).astype(int), minlength=36)
    fullest = int((bins + np.roll(bins, 1) + np.roll(bins, -1)).argmax())
    centre = (fullest + 0.5) * HISTOGRAM_DEGREES
    gaps = (degrees - centre + 180) % 360 - 180
    near = gaps[np.abs(gaps) < NEAR_DEGREES]
    return centre + float(np.median(near)) if len(near) else 0.0
