"""Matching by descriptors alone: all of one image with all of the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .._shared.errors import OptionError
from .._shared.machine import require_memory
from .._shared.options import suggest_keywords
from ..features.keypoints import Keypoints
from ..features.matchers import get_matcher, match_descriptors
from ..features.matches import Matches
from ..features.sift import get_descriptor, scaled_sift_descriptors, to_root_sift
from .options import MatchingOptions


@suggest_keywords
def match_features(
    features0: Keypoints,
    features1: Keypoints,
    *,
    matcher: str = "auto",
    ratio: float = 0.8,
    mutual: bool = True,
    seed: int = 0,
) -> Matches:
    """Match the descriptors of two images, as `extract` returns them: by these alone.

    Args:
        features0, features1: keypoints with descriptors of one type.
        matcher: "auto" ("exact" for few keypoints, else "patchmatch" for dense ones and "flann" for
            others), "flann", "exact", "faiss", "patchmatch", or "hamming" for binary descriptors.
        ratio: the distance of the best over that of the second-best must be below this.
        mutual: keep only mutual nearest neighbours.
        seed: of a matcher that is random.

    Returns:
        The matches, of the model "none"; their scores are 1 - ratio.

    Raises:
        OptionError: an option is unknown or out of its range, keypoints have no descriptors, or
            those of the two images are of unlike types; or there are too many for the memory.

    Example:
        >>> from deepdetect import PointDetector
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64), np.uint8).repeat(2, 0).repeat(2, 1)
        >>> features = PointDetector(100).extract(image)
        >>> matches = match_features(features, features)
        >>> bool((matches.points0 == matches.points1).all())
        True
    """
    if features0.descriptors is None or features1.descriptors is None:
        raise OptionError("these keypoints have no descriptors: find them by `extract`")
    if features0.descriptor_type != features1.descriptor_type:
        raise OptionError(
            f"descriptors of the types {features0.descriptor_type} and "
            f"{features1.descriptor_type} cannot be compared: extract both alike"
        )
    if not 0 < ratio <= 1:
        raise OptionError(f"the ratio must be above 0 and at most 1, not {ratio}")
    alike = features0.sizes is None and features1.sizes is None  # all of one scale and angle
    matches = match_descriptors(
        features0.descriptors,
        features1.descriptors,
        get_matcher(matcher),
        ratio=ratio,
        mutual=mutual,
        seed=seed,
        positions=(features0.xy, features1.xy) if alike else None,
    )
    return Matches(
        features0.xy[matches.indices0],
        features1.xy[matches.indices1],
        np.clip(1 - matches.ratios, 0, 1),
        np.ones(len(matches), bool),
        "none",
        None,
        features0,
        features1,
        indices0=matches.indices0,
        indices1=matches.indices1,
    )


def describe(gray: np.ndarray, keypoints: Keypoints, options: MatchingOptions) -> Keypoints:
    """Add descriptors at the keypoints' own sizes and angles, or at those of the options."""
    if keypoints.sizes is None or keypoints.angles is None:
        of_pixels = get_descriptor(options.descriptor)
        descriptors = of_pixels(gray, keypoints.xy, options.keypoint_size, options.angle)
    else:
        scaled = keypoints.xy, keypoints.sizes, keypoints.angles
        descriptors = scaled_sift_descriptors(gray, *scaled)
        if options.descriptor == "rootsift":
            descriptors = to_root_sift(descriptors, True)
    return replace(keypoints, descriptors=descriptors, descriptor_type=options.descriptor)


def check_memory(keypoints: Sequence[int]) -> None:
    """Raise an OptionError where descriptors and their search trees would fill the memory."""
    require_memory(
        f"matches of {' and '.join(f'{count:,}' for count in keypoints)} keypoints",
        "make them fewer with max_keypoints, density, or a smaller resolution",
        matched_keypoint=sum(keypoints),
    )
