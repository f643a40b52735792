"""A filter of mutual nearest neighbours that compares each match with the matches around it.

From one image to the other, correct matches move, rotate and change scale as their neighbours do,
but wrong matches do so at random. A network of 25,000 parameters (MATCH_FILTER_CARD.md) has learned
how similarly neighbours change, also on surfaces that bend and move. It sees Lowe's ratios but no
descriptors, so it suits several types of descriptors. The filter replaces the ratio test, which
discards correct matches on repeated structures.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .._shared.errors import OptionError, check_name
from .._shared.opencv import cv2
from .keypoints import Keypoints
from .learned import CROSS_MODAL, UPRIGHT_DEGREES, common_turn, is_learned
from .matchers import DescriptorMatches, session_of
from .sift import ROOT_SIFT

MATCH_FILTER = Path(__file__).with_name("match_filter.onnx")

AROUND, MOST_DISTINCT = 8, 512
"""The network judges a match by its AROUND nearest matches in each image. The MOST_DISTINCT matches
with the lowest ratios determine the rotation between the images. Chosen by hand."""

FLANN_KDTREE_SINGLE, ALL_LEAVES = 4, -1
"""FLANN's codes for a kd-tree for few dimensions, and for an exact search."""


def check_filter(filter_by: str, ratio: float | None, mutual: bool) -> None:
    """Raise an OptionError if `filter_by` is unknown, or if the other options contradict it."""
    check_name("filter_by", filter_by, ("ratio", "neighbours"))
    if filter_by == "neighbours" and (ratio is not None or not mutual):
        raise OptionError("`filter_by='neighbours'` needs `mutual=True` and no `ratio`")


def suits_filter(features: Keypoints) -> bool:
    """Return whether keypoints have sizes, angles and descriptors that the filter supports.

    Cross-modal descriptors are not supported: where dark and bright are swapped between images,
    keypoints turn by 180 degrees.
    """
    kind, sizes, angles = features.descriptor_type, features.sizes, features.angles
    served = kind == ROOT_SIFT or (is_learned(kind) and not str(kind).startswith(CROSS_MODAL))
    if not served or sizes is None or angles is None:
        return False
    return bool((sizes > 0).all() and (angles >= 0).all())


def require_suited(*features: Keypoints) -> None:
    """Raise an OptionError if keypoints do not suit the filter."""
    if not all(map(suits_filter, features)):
        raise OptionError(
            "`filter_by='neighbours'` needs keypoints with sizes and angles, and learned "
            "descriptors or RootSIFT, as `PointDetector.extract` returns them: use 'ratio'"
        )


def filter_matches(
    features0: Keypoints, features1: Keypoints, matches: DescriptorMatches
) -> DescriptorMatches:
    """Keep the mutual nearest neighbours that are more likely correct than wrong.

    Keypoints must suit the filter (`suits_filter`). If there are at most `AROUND` matches, none is
    kept. In the result, `ratios` are the network's probabilities that matches are wrong.
    """
    if len(matches) <= AROUND:
        none = np.empty(0, np.int32)
        return DescriptorMatches(none, none, np.empty(0, np.float32))
    logits = session_of(MATCH_FILTER).run(None, filter_inputs(features0, features1, matches))[0]
    kept = logits > 0
    wrong = 1 / (1 + np.exp(logits[kept]))
    return DescriptorMatches(matches.indices0[kept], matches.indices1[kept], wrong)


def filter_inputs(
    features0: Keypoints, features1: Keypoints, matches: DescriptorMatches
) -> dict[str, np.ndarray]:
    """Return the network's inputs by name, with the rotation between the two images undone."""
    sizes, angles = [], []
    for features, rows in ((features0, matches.indices0), (features1, matches.indices1)):
        assert features.sizes is not None
        assert features.angles is not None
        sizes.append(features.sizes[rows])
        angles.append(features.angles[rows])
    turns = angles[1] - angles[0]
    turn = common_turn(turns[np.argsort(matches.ratios, kind="stable")[:MOST_DISTINCT]])
    turn = (turn + 180) % 360 - 180
    if abs(turn) < UPRIGHT_DEGREES:
        turn = 0.0
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    xy0, xy1 = features0.xy[matches.indices0], features1.xy[matches.indices1]
    return {
        "xy0": xy0,
        "xy1": xy1 @ np.array([[c, -s], [s, c]], np.float32),
        "sizes0": sizes[0],
        "sizes1": sizes[1],
        "turns": np.radians(turns - turn).astype(np.float32),
        "ratios": matches.ratios,
        "around": np.hstack([nearest_rows(xy0), nearest_rows(xy1)]),
    }


def nearest_rows(xy: np.ndarray) -> np.ndarray:
    """Return the rows of the `AROUND` other positions nearest to each of N > `AROUND` positions."""
    own = np.arange(len(xy))[:, None]
    tree = cv2.flann_Index(xy, {"algorithm": FLANN_KDTREE_SINGLE, "leaf_max_size": 10})
    near = tree.knnSearch(xy, AROUND + 1, params={"checks": ALL_LEAVES})[0].astype(np.int64)
    # Each position's own row is moved to the end and dropped. If many positions coincide, the own
    # row may be missing; then the last row is dropped.
    return np.take_along_axis(near, np.argsort(near == own, axis=1, kind="stable"), 1)[:, :-1]
