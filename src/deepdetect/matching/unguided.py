"""Matching by descriptors alone: all of one image with all of the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .._shared.memory import require_memory
from .._shared.timing import StageTimer
from ..features.keypoints import Keypoints
from ..features.matchers import DescriptorMatches, get_matcher, match_descriptors
from ..features.sift import get_descriptor, scaled_sift_descriptors, to_root_sift
from .options import MatchingOptions


def unguided_matches(
    grays: Sequence[np.ndarray],
    keypoints: Sequence[Keypoints],
    options: MatchingOptions,
    timer: StageTimer | None = None,
) -> DescriptorMatches:
    """Match all descriptors with all others.

    Keypoints with sizes and angles are described at these, others all alike.

    Raises:
        OptionError: there are too many keypoints for the memory.
    """
    timer = timer or StageTimer()
    check_memory([len(each) for each in keypoints])
    with timer.stage("descriptors"):
        descriptors = [
            _describe(gray, each, options) for gray, each in zip(grays, keypoints, strict=True)
        ]
    with timer.stage("matching"):
        return match_descriptors(
            descriptors[0],
            descriptors[1],
            get_matcher(options.matcher),
            ratio=options.ratio,
            mutual=options.mutual,
            seed=options.geometry.seed,
            positions=_dense_positions(keypoints),
        )


def _dense_positions(
    keypoints: Sequence[Keypoints],
) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the positions of keypoints of one scale; None of those with their own."""
    if any(each.sizes is not None for each in keypoints):
        return None
    return keypoints[0].xy, keypoints[1].xy


def _describe(gray: np.ndarray, keypoints: Keypoints, options: MatchingOptions) -> np.ndarray:
    """Return descriptors at the keypoints' own sizes and angles, or at those of the options.

    Another size or angle than the default, or another descriptor, is for all keypoints.
    """
    default = MatchingOptions()
    alike = (options.keypoint_size, options.angle) != (default.keypoint_size, default.angle)
    own = keypoints.sizes is not None and keypoints.angles is not None
    if alike or not own or options.descriptor not in ("sift", "rootsift"):
        describe = get_descriptor(options.descriptor)
        return describe(gray, keypoints.xy, options.keypoint_size, options.angle)
    assert keypoints.sizes is not None
    assert keypoints.angles is not None
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
