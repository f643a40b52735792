"""Homography or fundamental matrix: whether the matches of a scene show depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .._shared.options import check_ranges


@dataclass(frozen=True)
class ModelSelectionOptions:
    """When a scene has depth.

    A fundamental matrix explains some matches of a plane, too, as its band is easily hit, but few
    of those that the homography does not explain.

    Attributes:
        min_fraction_of_rest: of the matches that the homography leaves, the fundamental matrix must
            explain at least this fraction.
        min_fraction_of_all: these must be at least this fraction of all that it explains.

    Raises:
        OptionError: a value is out of its range.
    """

    min_fraction_of_rest: float = 0.5
    min_fraction_of_all: float = 0.1

    def __post_init__(self) -> None:
        check_ranges(self, fractions=("min_fraction_of_rest", "min_fraction_of_all"))


def select_model(
    homography_inliers: np.ndarray,
    fundamental_inliers: np.ndarray,
    options: ModelSelectionOptions = ModelSelectionOptions(),
) -> str:
    """Return the model of a scene: "homography" (no depth) or "fundamental".

    Example:
        >>> plane = np.arange(100) < 60
        >>> select_model(plane, plane), select_model(plane, np.arange(100) < 95)
        ('homography', 'fundamental')
    """
    gained = np.count_nonzero(fundamental_inliers & ~homography_inliers)
    needed = max(
        options.min_fraction_of_rest * np.count_nonzero(~homography_inliers),
        options.min_fraction_of_all * np.count_nonzero(fundamental_inliers),
        1,
    )
    return "fundamental" if gained >= needed else "homography"
