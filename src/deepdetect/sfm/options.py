"""How many images become cameras and points: all options at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from .._shared.errors import unknown_name
from .._shared.options import check_ranges, suggest_keywords

PairChoice = Literal["auto", "all", "sequential", "similar"]

MAX_EXHAUSTIVE = 50
"""Images of which "auto" matches all pairs."""


@suggest_keywords
@dataclass(frozen=True)
class MultiViewOptions:
    """How many images become cameras and points.

    Attributes:
        pairs: which images are matched: "all", "sequential" (neighbours in the order of their
            names), "similar" (the most alike), or "auto": all of up to 50, else the most alike.
        sequential: number of following images that each one is matched with.
        ratio: of the ratio test: the best distance must be below this share of the second-best.
        dense: whether dense points are made.
        stride_px: a dense point is sought at every so many pixels of a row and of a column.
        single_camera: whether images of one size were taken by one camera; None: where their EXIF
            gives one focal length, or none.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    pairs: PairChoice = "auto"
    sequential: int = 10
    ratio: float = 0.85
    dense: bool = True
    stride_px: int = 2
    single_camera: bool | None = None

    def __post_init__(self) -> None:
        if self.pairs not in get_args(PairChoice):
            raise unknown_name("way to choose pairs", self.pairs, get_args(PairChoice))
        check_ranges(
            self,
            positive=("sequential",),
            fractions=("ratio",),
            between={"stride_px": (1, np.inf)},
        )

    def pair_choice(self, count: int) -> str:
        """Return how the pairs of so many images are chosen."""
        if self.pairs != "auto":
            return self.pairs
        return "all" if count <= MAX_EXHAUSTIVE else "similar"
