"""Matching of descriptors by an ONNX graph, in a runtime that may use a graphics card."""

from __future__ import annotations

import numpy as np

from ..detector.backends import RuntimeOptions, open_graph
from ..features.matchers import PRODUCTS, DescriptorMatches


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
    if len(descriptors0) == 0 or len(descriptors1) < 2:  # there is no second-best neighbour
        none = np.empty(0, np.int32)
        return DescriptorMatches(none, none, np.empty(0, np.float32))
    session = open_graph(PRODUCTS / "nearest.onnx", runtime)
    inputs = {"a": descriptors0, "b": np.ascontiguousarray(descriptors1.T)}
    similarities, columns, rows = session.run(["similarities", "columns", "rows"], inputs)
    best, second = np.sqrt(2 - 2 * similarities.clip(-1, 1)).T
    ratios = np.divide(best, second, out=np.ones_like(best), where=second > 0)
    kept = ratios < ratio
    if mutual:
        kept &= rows[columns[:, 0]] == np.arange(len(columns))
    rows0 = np.flatnonzero(kept).astype(np.int32)
    return DescriptorMatches(rows0, columns[rows0, 0].astype(np.int32), ratios[rows0])
