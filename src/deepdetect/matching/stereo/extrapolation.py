"""Disparities extrapolated to the border of an image, where the other view does not reach."""

from __future__ import annotations

import numpy as np

from ..._shared.parallel import parallel_for
from .consistency import MAX_DIFFERENCE_PX

MIN_SUPPORT_PX = 5
"""Fewest known pixels that a line is fitted to."""


def extrapolate_disparity(
    disparity: np.ndarray, known: np.ndarray, carried: np.ndarray
) -> np.ndarray:
    """Extrapolate the first and the last known surface of each row to the border of the image.

    Only to pixels whose place would lie outside the right image, since a surface that is in sight
    has matches of its own; and only where the surfaces above, below and beside suggest it, too. It
    follows a line, as far as that can be trusted: at a distance of n pixels the line through the n
    known pixels from the nth on must predict those before, to `MAX_DIFFERENCE_PX`.

    Args:
        disparity, known: as of `consistency`.
        carried: (H, W) float32, what semi-global matching chooses for each pixel; where nothing can
            be seen that is the disparity, not extrapolated, that the most paths bring.

    Returns:
        (H, W) float32, NaN where nothing is extrapolated.

    Example:
        >>> disparity = np.tile(np.linspace(8, 3, 51, dtype=np.float32), (2, 1))
        >>> known = np.tile(np.arange(51) >= 8, (2, 1))
        >>> extrapolate_disparity(disparity, known, np.full_like(disparity, 7))[0, :9].round(1)
        array([8. , 7.9, 7.8, 7.7, 7.6, 7.5, 7.4, 7.3, nan], dtype=float32)
    """
    from . import extrapolation_kernel as kernel

    shape = disparity.shape
    limits = MIN_SUPPORT_PX, np.float32(MAX_DIFFERENCE_PX)
    from_left, from_right = np.full((2, *shape), np.nan, np.float32)
    parallel_for(
        len(disparity), kernel.extrapolate_rows, disparity, known, carried, 1.0, *limits, from_left
    )
    mirrored = (np.ascontiguousarray(view[:, ::-1]) for view in (disparity, known, carried))
    parallel_for(len(disparity), kernel.extrapolate_rows, *mirrored, -1.0, *limits, from_right)
    return np.where(np.isfinite(from_left), from_left, from_right[:, ::-1])
