"""The matchers: one line each.

To add a matcher, write its module beside this one, with a function
`(queries, base, count, seed) -> (rows, distances)`, and add its line.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..errors import look_up
from .exact import exact_neighbours
from .flann import flann_neighbours
from .hamming import hamming_neighbours

Matcher = Callable[[np.ndarray, np.ndarray, int, int], tuple[np.ndarray, np.ndarray]]

MATCHERS: dict[str, Matcher] = {
    "flann": flann_neighbours,
    "exact": exact_neighbours,
    "hamming": hamming_neighbours,
}


def get_matcher(name: str) -> Matcher:
    """Look a matcher up.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("matcher", name, MATCHERS)
