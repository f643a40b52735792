"""The values of black and white in uint16 images that do not state them, one range for a call."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field

import numpy as np

SENSOR_BITS = (8, 10, 12, 14, 16)
"""Bit depths of sensors. A uint16 image is assumed to have the smallest that holds its values."""

LITTLE_RANGE = 1 / 8
"""An image that uses less than this fraction of its range causes a warning, because few grey levels
are left of it. Chosen by hand."""

MAX_OUTLIERS = 1e-3
"""This share of the pixels may lie outside the range, because sensors have hot and dead pixels: up
to one in a thousand. Chosen by hand."""

ValueRange = tuple[float, float]


@dataclass
class RangeOfCall:
    """The range of the images of one call, `fixed`, or the counts of their values until then."""

    fixed: ValueRange | None = None
    counts: np.ndarray = field(default_factory=lambda: np.zeros(1 << 16, np.int64))
    used: set[ValueRange] = field(default_factory=set)
    name: str = ""

    def settle(self) -> bool:
        """Fix the range of all images counted; return whether any was read with another one."""
        if self.used:
            self.fixed = find_range(self.counts, f"{self.name} or an image beside it")
        return bool(self.used) and self.used != {self.fixed}


_call: ContextVar[RangeOfCall | None] = ContextVar("range of call", default=None)


@contextmanager
def range_of_call(call: RangeOfCall | None) -> Iterator[None]:
    """Read uint16 images in the block with the range of this call, or collect their values."""
    token = _call.set(call)
    try:
        yield
    finally:
        _call.reset(token)


def range_of_uint16(array: np.ndarray, name: str) -> ValueRange:
    """Return the values of black and white of a uint16 image that does not state them."""
    counts = np.bincount(array.ravel(), minlength=1 << 16)
    call = _call.get()
    if call is None:
        return find_range(counts, name)
    if call.fixed is not None:
        low, high = call.fixed
        outside = counts[1 : max(1, int(np.ceil(low)))].sum() + counts[int(high) + 1 : -1].sum()
        if outside > MAX_OUTLIERS * counts.sum():
            beyond = f"{outside / counts.sum():.1%} of {name} lies outside {low:g} to {high:g}, the"
            what = f"{beyond} range of the images read before: give the range by `value_range`"
            warnings.warn(what, UserWarning, stacklevel=2)
        return call.fixed
    call.counts += counts
    call.name = call.name or name
    found = find_range(counts)
    call.used.add(found)
    return found


def find_range(counts: np.ndarray, name: str | None = None) -> ValueRange:
    """Find the values of black and white from the counts of all 65536 values.

    White is the largest value of a sensor. Few pixels above it, and padding with 65535, are left
    out if the octave above it is empty: highlights would lie there. Black is 0. But a narrow band
    of values that lies farther from 0 than it is wide is spread over all grey levels, as far as
    each value has a level of its own. With a `name`, little use of the range causes a warning.
    """
    levels = np.flatnonzero(counts)
    full = _white_above(levels.max(initial=0))
    inner = levels[(levels > 0) & (levels < 65535)]  # 0 and 65535 may be padding
    if not len(inner):
        return 0, full
    total = np.cumsum(counts[inner])
    least, most = MAX_OUTLIERS * total[-1], (1 - MAX_OUTLIERS) * total[-1]
    low, high = (int(inner[np.searchsorted(total, share)]) for share in (least, most))
    white = _white_above(high)
    gap = not counts[white + 1 : 2 * white + 2].any()
    padded = counts[65535] > MAX_OUTLIERS * total[-1]
    if not gap or (padded and white < 256):
        white, high = full, 65535 if padded else high
    width = high - low
    narrow = 0 < width < min(low, LITTLE_RANGE * white)
    if name is not None and (narrow or 0 < high < LITTLE_RANGE * white):
        tell_if_little(width / white, f"{name}, with values from {low} to {high},")
    if not narrow:
        return 0, white
    least, most = int(inner[0]), int(inner[inner <= white][-1])
    low, high = max(least, low - width), min(most, high + width)
    margin = max(0, 255 - (high - low))
    return low - margin // 2, high + margin - margin // 2


def tell_if_little(used: float, name: str) -> None:
    """Warn if an image uses a small fraction of its range, but not if it shows nothing."""
    if 0 < used < LITTLE_RANGE:
        what = f"{name} uses {used:.1%} of its range: give the range by `value_range`"
        warnings.warn(what, UserWarning, stacklevel=2)


def _white_above(value: int) -> int:
    return 2 ** next(bits for bits in SENSOR_BITS if value < 2**bits) - 1
