"""Heat maps and logits that are never held together, and never looked at whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

Rows = Callable[[slice], np.ndarray]
"""What gives the rows of a map that are asked for."""

BAND_PIXELS = 4_000_000
"""Of a map that are looked at at a time."""


@dataclass(frozen=True, eq=False)
class Maps:
    """A heat map and the logits by which its pixels are ranked, each made when it is asked for.

    Of a large image either takes more memory than most of its keypoints: one is held at a time.

    Attributes:
        shape: (H, W).
        heatmap: makes the map, (H, W) float32, and gives its rows.
        logits: makes the logits, (H, W) float32.
    """

    shape: tuple[int, ...]
    heatmap: Callable[[], Rows]
    logits: Callable[[], np.ndarray]

    @classmethod
    def of_logits(cls, logits: np.ndarray) -> Maps:
        """Return maps whose heat map is the sigmoid of the logits, and is never held whole."""
        return cls(logits.shape, lambda: lambda rows: sigmoid(logits[rows]), lambda: logits)

    def both(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the whole heat map and the logits, (H, W) float32 both."""
        heatmap, rows_of = np.empty(self.shape, np.float32), self.heatmap()
        for rows in bands(self.shape):
            heatmap[rows] = rows_of(rows)
        del rows_of  # it may hold another map
        return heatmap, self.logits()


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Return the probabilities of logits; the exponent is never positive: nothing overflows."""
    decay = np.exp(-np.abs(logits))
    return np.where(logits >= 0, np.float32(1), decay) / (1 + decay)


def bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield rows of a map in bands, to bound the memory of what is made of them."""
    rows = max(1, BAND_PIXELS // max(1, shape[1]))
    for start in range(0, shape[0], rows):
        yield slice(start, min(start + rows, shape[0]))
