"""Matching by attention: a network that sees all keypoints of both images before it matches any.

The network (ATTENTION_CARD.md) has layers in which each keypoint attends to all keypoints of its
own image, and then to all of the other image. So the position of a point among the others counts
when one place looks like another, or unlike itself at another time of day. Its time grows with the
square of the number of keypoints. The method is that of LightGlue (Lindenberger et al., 2023).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from .._shared.errors import OptionError
from ..detector.backends import RuntimeOptions, open_graph
from ..detector.backends.interface import run_graph
from ..features.keypoints import Keypoints
from ..features.learned import (
    LEARNED,
    UPRIGHT_DEGREES,
    match_turned,
    ratio_limit,
    turn_descriptors,
)
from ..features.matchers import DescriptorMatches, exact_neighbours, match_descriptors

ATTENTION = Path(__file__).with_name("attention.onnx")

OUTPUTS = "partners", "probabilities", "back"

MIN_PROBABILITY = 0.3
"""Matches of a lower probability are left out."""

MEAN_LOG_SIZE = 2.5
"""Approximate mean of the logarithm of keypoint sizes in pixels; the network reads deviations."""


def match_by_attention(
    features0: Keypoints,
    features1: Keypoints,
    runtime: RuntimeOptions = RuntimeOptions(),
    least: float = MIN_PROBABILITY,
) -> DescriptorMatches:
    """Match keypoints one to one; `ratios` are the probabilities that matches are wrong.

    Matches with a probability below `least` are left out. The network needs memory for several
    numbers per pair of keypoints.
    """
    if not (len(features0) and len(features1)):
        none = np.empty(0, np.int32)
        return DescriptorMatches(none, none, np.empty(0, np.float32))
    inputs = attention_inputs(features0, features1)
    what = f"{len(features0):,} x {len(features1):,} keypoints"
    try:
        found = run_graph(open_graph(ATTENTION, runtime), OUTPUTS, inputs, what)
    except MemoryError:
        raise OptionError(
            f"there is not enough memory to match {what} by attention: use fewer keypoints"
        ) from None
    partners, probabilities, back = found
    mutual = back[partners] == np.arange(len(partners))
    rows = np.flatnonzero(mutual & (probabilities > least)).astype(np.int32)
    return DescriptorMatches(rows, partners[rows].astype(np.int32), 1 - probabilities[rows])


def attention_inputs(features0: Keypoints, features1: Keypoints) -> dict[str, np.ndarray]:
    """Return the network's inputs by name, with the rotation between the images undone.

    `xy0` (N, 2) are positions relative to the middle of the image, in units of half its longer
    side. `descriptors0` (N, 64) are upright. `traits0` (N, 4) are the logarithm of the size, the
    cosine and the sine of the angle, and the score. The same for the second image.
    """
    match = partial(
        match_descriptors, matcher=exact_neighbours, ratio=ratio_limit(LEARNED), mutual=True
    )
    turn = (match_turned(features0, features1, match)[1] + 180) % 360 - 180
    turn = 0.0 if abs(turn) < UPRIGHT_DEGREES else turn
    inputs: dict[str, np.ndarray] = {}
    for number, (features, degrees) in enumerate(((features0, 0.0), (features1, turn))):
        assert features.descriptors is not None
        assert features.sizes is not None
        assert features.angles is not None
        size, angles = np.array(features.image_size), np.radians(features.angles - degrees)
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        placed = (features.xy - (size - 1) / 2) @ np.array([[c, -s], [s, c]]) / (size.max() / 2)
        traits = [
            np.log(features.sizes) - MEAN_LOG_SIZE,
            np.cos(angles),
            np.sin(angles),
            features.scores,
        ]
        inputs[f"xy{number}"] = placed.astype(np.float32)
        inputs[f"descriptors{number}"] = turn_descriptors(
            features.descriptors, features.angles - degrees
        )
        inputs[f"traits{number}"] = np.column_stack(traits).astype(np.float32)
    return inputs
