"""Words and figures that go into a file beside the points."""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Real

Notes = Mapping[str, str | int | float]


def worded(notes: Notes) -> dict[str, str]:
    """Write each note as one line of text: whole numbers with commas, others with four digits.

    Example:
        >>> worded({"points": 49979, "within 1 px": 0.95312, "scene": "the  cones"})
        {'points': '49,979', 'within 1 px': '0.9531', 'scene': 'the cones'}
    """
    return {" ".join(str(name).split()): _text(value) for name, value in notes.items()}


def _text(value: str | int | float) -> str:
    if isinstance(value, bool) or not isinstance(value, Real):  # numpy's numbers are Real
        return " ".join(str(value).split())
    return f"{int(value):,}" if float(value).is_integer() else f"{value:.4g}"
