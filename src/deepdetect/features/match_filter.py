"""Which mutual nearest neighbours are right, by what those around them do.

Right matches move, turn and grow as their neighbours do, wrong ones as it happens. A network of
25,000 parameters (MATCH_FILTER_CARD.md) has learned how alike these are where surfaces bend and
move; descriptors take part by their ratio alone, so that it serves several kinds. It stands in for
the ratio test, which throws away what is right and occurs twice.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np

from .._shared.runtimes import start_session
from .keypoints import Keypoints
from .learned import UPRIGHT_DEGREES, common_turn, is_learned
from .matchers import DescriptorMatches, automatic_neighbours
from .sift import ROOT_SIFT

MATCH_FILTER = Path(__file__).with_name("match_filter.onnx")

AROUND = 8
"""Nearest matches that each is compared with, in either image."""

MOST_DISTINCT = 512
"""Matches of the lowest ratios, which tell by how much one image is turned."""


def suits_filter(features: Keypoints) -> bool:
    """Return whether keypoints have what the filter looks at, and descriptors that it knows."""
    known = is_learned(features.descriptor_type) or features.descriptor_type == ROOT_SIFT
    return known and features.sizes is not None and features.angles is not None


def filter_matches(
    features0: Keypoints, features1: Keypoints, matches: DescriptorMatches
) -> DescriptorMatches:
    """Keep the mutual nearest neighbours that are more likely right than wrong.

    The keypoints have sizes and angles. In place of the ratios the result has the probability of
    being wrong.
    """
    if not len(matches):
        return matches
    logits = _session().run(None, filter_inputs(features0, features1, matches))[0]
    kept = logits > 0
    wrong = 1 / (1 + np.exp(logits[kept]))
    return DescriptorMatches(matches.indices0[kept], matches.indices1[kept], wrong)


def filter_inputs(
    features0: Keypoints, features1: Keypoints, matches: DescriptorMatches
) -> dict[str, np.ndarray]:
    """Return what the network is given, by name: matches of images of which one is turned back."""
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
    """Return the rows of the `AROUND` nearest others; where there are fewer, the own one."""
    own = np.arange(len(xy))[:, None]
    near = automatic_neighbours(xy, xy, min(AROUND + 1, len(xy)), 0)[0].astype(np.int64)
    # The own one comes last then; it is not among them where many are at one place.
    others = np.take_along_axis(near, np.argsort(near == own, axis=1, kind="stable"), 1)[:, :-1]
    return np.hstack([others, np.repeat(own, AROUND - others.shape[1], axis=1)])


@functools.cache
def _session() -> Any:
    return start_session(str(MATCH_FILTER))
