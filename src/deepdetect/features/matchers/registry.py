"""The matchers: one line each.

To add a matcher, write its module beside this one, with a function
`(queries, base, count, seed, positions) -> (rows, distances)`, and add its line.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from ..._shared.errors import look_up
from .exact import exact_neighbours
from .faiss_ivf import faiss_neighbours
from .flann import flann_neighbours
from .hamming import hamming_neighbours
from .patchmatch import patchmatch_neighbours


class Matcher(Protocol):
    """Finds the nearest neighbours of descriptors."""

    def __call__(
        self,
        queries: np.ndarray,
        base: np.ndarray,
        count: int,
        seed: int,
        positions: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (N, count) int32 rows of `base` and (N, count) float32 distances."""
        ...


MATCHERS: dict[str, Matcher] = {
    "flann": flann_neighbours,
    "exact": exact_neighbours,
    "faiss": faiss_neighbours,
    "patchmatch": patchmatch_neighbours,
    "hamming": hamming_neighbours,
}


def get_matcher(name: str) -> Matcher:
    """Look a matcher up.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("matcher", name, MATCHERS)
