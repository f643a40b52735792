"""Charts and pictures of a report, as PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .._shared.errors import require_packages
from .._shared.opencv import cv2

MARKERS = ("o", "s", "^", "x")
DASHES = ("-", "--", ":", "-.")

WIDEST = 1600
"""Pixels; wider pictures are shrunk."""


def bar_chart(values: Mapping[str, float], label: str, highlighted: Sequence[str] = ()) -> bytes:
    """Draw horizontal bars by name, with the value beside each, some in another colour."""
    figure = _figure(8, 0.32 * len(values) + 1)
    axes = figure.subplots()
    colors = ["C1" if name in highlighted else "C0" for name in values]
    bars = axes.barh(list(values), list(values.values()), color=colors)
    axes.bar_label(bars, fmt="{:.3f}", padding=3)
    axes.invert_yaxis()
    axes.set_xlabel(label)
    axes.set_xlim(left=0)
    axes.margins(x=0.12)
    axes.grid(axis="x", alpha=0.3)
    return _saved(figure)


def line_chart(
    lines: Mapping[str, tuple[Sequence[float], Sequence[float]]],
    x_label: str,
    y_label: str,
    *,
    logarithmic: bool = False,
    ticks: Sequence[float] = (),
) -> bytes:
    """Draw lines of (x, y) values, with their names in a legend; one of one value is a point.

    The x axis may be logarithmic, and have ticks of its own.
    """
    figure = _figure(11, max(4.5, 0.27 * len(lines) + 0.5))
    axes = figure.subplots()
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.grid(alpha=0.3)
    for k, (name, (x, y)) in enumerate(lines.items()):
        # Ten colours, and other marks and lines each time round.
        marker, dash = MARKERS[k // 10 % len(MARKERS)], DASHES[k // 10 % len(DASHES)]
        axes.plot(x, y, label=name, color=f"C{k % 10}", marker=marker, linestyle=dash)
    if logarithmic:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("{x:g}")
    if ticks:
        axes.set_xticks(ticks, [f"{tick:,g}" for tick in ticks], minor=False)
        axes.set_xticks([], minor=True)
    if lines:
        axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.01, 0.5))
    return _saved(figure)


def picture(rgb: np.ndarray) -> bytes:
    """Encode a (H, W, 3) uint8 RGB picture, shrunk where it is very wide."""
    if rgb.shape[1] > WIDEST:
        size = (WIDEST, round(rgb.shape[0] * WIDEST / rgb.shape[1]))
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1].tobytes()


def _figure(width: float, height: float) -> Any:
    require_packages("a chart of the report", "matplotlib")
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _saved(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
