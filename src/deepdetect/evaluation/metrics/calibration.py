"""Whether probabilities are right: of the pixels with one of 0.7, are 70 % marked?"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

NUM_BINS = 20


@dataclass(frozen=True, eq=False)
class Calibration:
    """The pixels of images by their probability, in bins of equal width.

    Attributes:
        pixels: (20,) number of pixels of each bin.
        probability: (20,) sum of their probabilities.
        marked: (20,) number of them that the masks mark.
        predicted: number of pixels with a probability over 0.5.
    """

    pixels: np.ndarray
    probability: np.ndarray
    marked: np.ndarray
    predicted: int

    @property
    def expected_error(self) -> float:
        """The expected calibration error (Naeini et al., 2015).

        The mean over all pixels of the difference, in the bin of a pixel, between the mean
        probability and the marked share.
        """
        return float(np.abs(self.probability - self.marked).sum() / self.pixels.sum())

    @property
    def density(self) -> float:
        """Keypoints per pixel at the threshold 0.5."""
        return float(self.predicted / self.pixels.sum())

    @property
    def label_density(self) -> float:
        """Marked pixels per pixel."""
        return float(self.marked.sum() / self.pixels.sum())

    def values(self) -> dict[str, float]:
        """Return the three numbers by name."""
        return {
            "calibration_error": self.expected_error,
            "density": self.density,
            "label_density": self.label_density,
        }


def calibration_of(heatmap: np.ndarray, mask: np.ndarray) -> Calibration:
    """Sort the pixels of a heat map by probability.

    Args:
        heatmap: (H, W) float32 probability.
        mask: (H, W) bool truth.

    Example:
        >>> found = calibration_of(np.full((2, 2), 0.8), np.array([[1, 1], [1, 0]], bool))
        >>> round(found.expected_error, 3), found.density, found.label_density
        (0.05, 1.0, 0.75)
    """
    probability = heatmap.astype(np.float64).ravel()
    bins = np.minimum((probability * NUM_BINS).astype(np.int64), NUM_BINS - 1)
    return Calibration(
        np.bincount(bins, minlength=NUM_BINS),
        np.bincount(bins, probability, NUM_BINS),
        np.bincount(bins, mask.ravel(), NUM_BINS),
        int(np.count_nonzero(heatmap > 0.5)),
    )


def pooled(calibrations: Iterable[Calibration]) -> Calibration:
    """Pool the pixels of several images."""
    listed = list(calibrations)
    return Calibration(
        np.sum([each.pixels for each in listed], axis=0),
        np.sum([each.probability for each in listed], axis=0),
        np.sum([each.marked for each in listed], axis=0),
        sum(each.predicted for each in listed),
    )
