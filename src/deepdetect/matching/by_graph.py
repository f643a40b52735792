"""Matching of descriptors by an ONNX graph, in a runtime that may use a graphics card."""

from __future__ import annotations

import numpy as np

from .._shared.errors import OptionError
from ..detector.backends import RuntimeOptions, backend_name, open_graph
from ..detector.backends.interface import run_graph
from ..features.matchers import PRODUCTS, DescriptorMatches, kept_matches

OUTPUTS = "similarities", "columns", "rows"


def match_by_graph(
    descriptors0: np.ndarray,
    descriptors1: np.ndarray,
    runtime: RuntimeOptions,
    *,
    ratio: float,
    mutual: bool,
) -> DescriptorMatches:
    """Match (N, D) with (M, D) unit vectors, as `match_descriptors` does with exact search.

    The device needs memory for N x M float32 numbers.
    """
    backend_name(runtime)
    if len(descriptors0) == 0 or len(descriptors1) < 2:  # there is no second-best neighbour
        none = np.empty(0, np.int32)
        return DescriptorMatches(none, none, np.empty(0, np.float32))
    session = open_graph(PRODUCTS / "nearest.onnx", runtime)
    inputs = {"a": descriptors0, "b": np.ascontiguousarray(descriptors1.T)}
    what = f"{len(descriptors0):,} x {len(descriptors1):,} descriptors"
    try:
        similarities, columns, rows = run_graph(session, OUTPUTS, inputs, what)
    except MemoryError:
        raise OptionError(
            f"there is not enough memory to compare {what}: use fewer keypoints, or leave "
            "`backend` and `device` out"
        ) from None
    distances = np.sqrt(2 - 2 * similarities.clip(-1, 1))
    return kept_matches(columns, distances, rows, ratio, mutual)
