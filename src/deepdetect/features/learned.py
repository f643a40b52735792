"""Learned descriptors, which are turned without looking at the image again."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from .keypoints import Keypoints
from .matchers import DescriptorMatches

LEARNED: Final = "learned"
LEARNED_FREE: Final = "learned-free"
CROSS_MODAL: Final = "cross-modal"
"""`Keypoints.descriptor_type` of these; the second by weights of photographs under free licences
alone, the third for images of different sensors, where what is dark in one may be bright in the
other. Of one's own weights it is "learned-" or "cross-modal-" and the beginning of the file's
SHA-256."""

RATIO, LEARNED_RATIO = 0.85, 0.88
"""Of the ratio test, of all others and of learned descriptors. On photos/val, with the second these
match neither unrelated photographs more often nor views of one less precisely than RootSIFT with
the first; .93 would be as precise, but match unrelated photographs four times as often."""

LENGTH = 64

CONSTANT = 16
"""So many numbers, the first, are the same in an image that is turned."""

FREQUENCIES = np.repeat([1, 2, 3], [12, 8, 4])
"""Of the others, which are the real and then the imaginary parts of complex numbers: an image that
is turned by an angle turns them by so many times the angle."""

UPRIGHT_DEGREES = 15.0
"""The network has learned to bear turns up to this: one that is wrong costs little."""

TURNED_KEYPOINTS = 512
"""So many, the best of each image, tell by how much one is turned."""

HISTOGRAM_DEGREES = 10
NEAR_DEGREES = 20
"""Bins of differences of angles, and how far from the fullest the others are counted with it."""


def is_learned(descriptor_type: str | None) -> bool:
    """Return whether descriptors are learned ones, by the weights here or by one's own."""
    return descriptor_type is not None and descriptor_type.startswith((LEARNED, CROSS_MODAL))


def angles_counted(descriptor_type: str) -> int:
    """Return how many times a keypoint's angle its descriptor is turned by.

    Twice those of images of different sensors: a gradient may point the other way.
    """
    return 2 if descriptor_type.startswith(CROSS_MODAL) else 1


def turn_descriptors(descriptors: np.ndarray, degrees: np.ndarray | float) -> np.ndarray:
    """Return (N, 64) float32 learned descriptors as in an image that is turned.

    By (N,) or one angle, as `Keypoints.angles`: from the axis of x to that of y.
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
) -> DescriptorMatches:
    """Match learned descriptors as upright ones of images of which one is turned back.

    Those at the keypoints' own angles bear any turn, and tell which it is; upright ones, which see
    how keypoints are turned to each other, find about a sixth more.
    """
    descriptors0, descriptors1 = features0.descriptors, features1.descriptors
    assert descriptors0 is not None
    assert descriptors1 is not None
    assert features0.descriptor_type is not None
    if features0.angles is None or features1.angles is None:
        return match(descriptors0, descriptors1)
    counted = angles_counted(features0.descriptor_type)
    angles0, angles1 = counted * features0.angles, counted * features1.angles
    own = match(descriptors0[:TURNED_KEYPOINTS], descriptors1[:TURNED_KEYPOINTS])
    turn = common_turn(angles1[own.indices1] - angles0[own.indices0])
    first = turn_descriptors(descriptors0, angles0)
    turned = match(first, turn_descriptors(descriptors1, angles1 - turn))
    if abs((turn + 180) % 360 - 180) < UPRIGHT_DEGREES:
        return turned
    # Where few match, it is chance which turn most of them show.
    return max(match(first, turn_descriptors(descriptors1, angles1)), turned, key=len)


def common_turn(degrees: np.ndarray) -> float:
    """Return the angle that most of (N,) differences of angles are near; 0 without any."""
    degrees = degrees % 360
    bins = np.bincount((degrees // HISTOGRAM_DEGREES).astype(int), minlength=36)
    fullest = int((bins + np.roll(bins, 1) + np.roll(bins, -1)).argmax())
    centre = (fullest + 0.5) * HISTOGRAM_DEGREES
    gaps = (degrees - centre + 180) % 360 - 180
    near = gaps[np.abs(gaps) < NEAR_DEGREES]
    return centre + float(np.median(near)) if len(near) else 0.0
