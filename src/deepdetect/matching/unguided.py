"""Matching by descriptors alone: all of one image with all of the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._shared.errors import OptionError
from .._shared.memory import require_memory
from .._shared.options import suggest_keywords
from .._shared.timing import StageTimer
from ..features.keypoints import Keypoints
from ..features.matchers import DescriptorMatches, get_matcher, match_descriptors
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
        >>> found = match_features(features, features)
        >>> bool((found.points0 == found.points1).all())
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
    found = _match(
        (features0, features1),
        (features0.descriptors, features1.descriptors),
        matcher=matcher,
        ratio=ratio,
        mutual=mutual,
        seed=seed,
    )
    return Matches(
        features0.xy[found.indices0],
        features1.xy[found.indices1],
        np.clip(1 - found.ratios, 0, 1),
        np.ones(len(found), bool),
        "none",
        None,
        features0,
        features1,
        indices0=found.indices0,
        indices1=found.indices1,
    )


def unguided_matches(
    grays: Sequence[np.ndarray],
    keypoints: Sequence[Keypoints],
    options: MatchingOptions,
    mutual: bool,
    seed: int,
    timer: StageTimer,
) -> DescriptorMatches:
    """Describe all keypoints, and match all with all others.

    Raises:
        OptionError: there are too many keypoints for the memory.
    """
    check_memory([len(each) for each in keypoints])
    with timer.stage("descriptors"):
        descriptors = [
            _describe(gray, each, options) for gray, each in zip(grays, keypoints, strict=True)
        ]
    with timer.stage("matching"):
        return _match(
            keypoints,
            descriptors,
            matcher=options.matcher,
            ratio=options.ratio,
            mutual=mutual,
            seed=seed,
        )


def _match(
    keypoints: Sequence[Keypoints],
    descriptors: Sequence[np.ndarray],
    *,
    matcher: str,
    ratio: float,
    mutual: bool,
    seed: int,
) -> DescriptorMatches:
    alike = all(each.sizes is None for each in keypoints)  # all of one scale and angle
    return match_descriptors(
        descriptors[0],
        descriptors[1],
        get_matcher(matcher),
        ratio=ratio,
        mutual=mutual,
        seed=seed,
        positions=(keypoints[0].xy, keypoints[1].xy) if alike else None,
    )


def _describe(gray: np.ndarray, keypoints: Keypoints, options: MatchingOptions) -> np.ndarray:
    """Return descriptors at the keypoints' own sizes and angles, or at those of the options."""
    if keypoints.sizes is None or keypoints.angles is None:
        describe = get_descriptor(options.descriptor)
        return describe(gray, keypoints.xy, options.keypoint_size, options.angle)
    found = scaled_sift_descriptors(gray, keypoints.xy, keypoints.sizes, keypoints.angles)
    return to_root_sift(found, True) if options.descriptor == "rootsift" else found


def check_memory(keypoints: Sequence[int]) -> None:
    """Stop before the descriptors and their search trees fill the memory.

    Raises:
        OptionError: there are too many.
    """
    require_memory(
        f"matches of {' and '.join(f'{count:,}' for count in keypoints)} keypoints",
        "make them fewer with max_keypoints, density, or a smaller resolution",
        matched_keypoint=sum(keypoints),
    )
