"""Guesses which values mean black and white in uint16 images that do not state them."""

from __future__ import annotations

import math
import warnings

import numpy as np

SENSOR_BITS = (8, 10, 12, 14, 16)
"""Bit depths of sensors. The smallest that holds the values of a uint16 image is assumed."""

LITTLE_RANGE = 1 / 8
"""An image whose values span less than this fraction of its range causes a warning, because few
grey levels are left when it is converted to 8 bits. Chosen by hand."""

MAX_OUTLIERS, FEW = 1e-3, 1e-2
"""The share of pixels outside the value range may be MAX_OUTLIERS at most, because sensors have
hot and dead pixels. The warning about LITTLE_RANGE ignores the share FEW of the darkest and of the
brightest pixels, because a flame or the sun may span most of the range. Chosen by hand."""

ValueRange = tuple[float, float]


def range_of_uint16(array: np.ndarray, name: str, call: ValueRange | None) -> ValueRange:
    """Return the values of black and white of a uint16 image that does not state them.

    If one call reads several images, they share one range, which is given as `call`.
    """
    counts = counts_of(array)
    low, high = map(round, call or find_range(counts))
    tell_if_little(array, _white_above(high) if low else high, name)
    outside = (counts[1 : max(1, low)].sum() + counts[high + 1 : -1].sum()) / max(array.size, 1)
    if outside > MAX_OUTLIERS:
        what = f"{outside:.1%} of {name} lies outside the images' common range, {low} to {high}"
        warnings.warn(f"{what}: give the range by `value_range`", UserWarning, stacklevel=2)
    return float(low), float(high)


def counts_of(values: np.ndarray) -> np.ndarray:
    """Count each of the 65536 values of a uint16 array."""
    return np.bincount(values.ravel(), minlength=1 << 16)


def find_range(counts: np.ndarray) -> ValueRange:
    """Find the values of black and white from the counts of all 65536 values.

    White is the largest value of the first bit depth in `SENSOR_BITS` that at most the share
    `MAX_OUTLIERS` of the pixels exceed; 65535 may be padding. Black is 0, unless the values lie in
    a narrow band farther from 0 than it is wide: then the range is that band, at least 255 wide.
    """
    levels = np.flatnonzero(counts)
    inner = levels[(levels > 0) & (levels < 65535)]  # 0 and 65535 may be padding
    if not len(inner):
        return 0, _white_above(levels.max(initial=0))
    total = np.cumsum(counts[inner])
    shares = (MAX_OUTLIERS * total[-1], (1 - MAX_OUTLIERS) * total[-1])
    low, high = inner[np.searchsorted(total, shares)].tolist()
    white = _white_above(high)
    if white < 256 and counts[65535] > shares[0]:  # not padding: lamps in a dark image
        white = high = 65535
    width = high - low
    if not 0 < width < min(low, LITTLE_RANGE * white):
        return 0, white
    low, high = max(inner[0], low - width), min(inner[inner <= white][-1], high + width)
    margin = max(0, 255 - (high - low))
    return float(low - margin // 2), float(high + margin - margin // 2)


def tell_if_little(values: np.ndarray, white: float, name: str) -> None:
    """Warn if an image uses a small fraction of its range from 0 to `white`."""
    step = 1 + math.isqrt(values.size >> 16)  # a grid of about 65,536 values, to save time
    seen = values[::step, ::step]
    seen = seen[(seen > 0) & (seen < white)]  # the ends may be padding
    if not len(seen):
        return
    low, high = np.quantile(seen.astype(np.float64), (FEW, 1 - FEW))
    used = (high - low if high - low < low else high) / white
    if 0 < used < LITTLE_RANGE:
        what = f"{name} uses {used:.1%} of its range: give the range by `value_range`"
        warnings.warn(what, UserWarning, stacklevel=2)


def _white_above(value: int) -> int:
    return 2 ** next(bits for bits in SENSOR_BITS if value < 2**bits) - 1
