"""Plot repeatability and matches against time, from times.csv and descriptors.csv in docs/results.

python docs/figures/times.py    # writes docs/images/times.png and, for the README, speed.png
"""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
from matplotlib import pyplot
from matplotlib.ticker import LogLocator

DOCS = Path(__file__).parents[1]
PANELS = {
    "@1": "repeatability within 1 px, one to one",
    "@3": "repeatability within 3 px, one to one",
    "right at 3 px": "correct matches of a pair, within 3 px",
}
MARKERS = {"own": "o", "RootSIFT": "s", "own size and angle": "^"}
TIME = "1 thread, ms"

SHOWN = {
    "times": {
        "SIFT|own": "SIFT",
        "ORB|own": "ORB",
        "|det Hessian|, sigma 3|RootSIFT": "|det Hessian|, one scale",
        "|det Hessian|, seven scales|own size and angle": "|det Hessian|, seven scales",
        "points|own size and angle": "points, RootSIFT",
        "XFeat|own": "XFeat",
        "EdgePoint2 T32|own": "EdgePoint2 T32",
        "EdgePoint2 E64|own": "EdgePoint2 E64",
        "dense, default|RootSIFT": "best dense pixels",
    },
    "descriptors": {
        "SIFT": "SIFT, RootSIFT",
        "rootsift": "points, RootSIFT",
        "learned": "points, learned",
        "XFeat": "XFeat",
        "EdgePoint2 T32": "EdgePoint2 T32",
        "EdgePoint2 E64": "EdgePoint2 E64",
    },
}
"""Rows that the README's figure shows, with their names there."""


MOVED = {
    "best dense pixels": {"xytext": (-9, 0), "ha": "right"},
    "EdgePoint2 E64": {"xytext": (-7, 0), "ha": "right"},
    "EdgePoint2 T32": {"xytext": (-7, 0), "ha": "right"},
    "|det Hessian|, seven scales": {"xytext": (0, -12), "ha": "center"},
}
"""Positions, in points, of names that would otherwise overlap others. Chosen by hand."""

DESCRIBED = {
    "Oxford, no ratio test": ["zoom and rotation", "blur", "viewpoint", "light and JPEG"],
    "HPatches (held out), no ratio test": ["HPatches"],
}
"""Panels, and the columns of descriptors.csv whose mean they show: 10 pairs of Oxford each."""

SPEED_X = (0.04, 5)
"""Range of the time axis, relative to OpenCV's SIFT. Chosen by hand."""


def main() -> None:
    """Draw both figures."""
    draw_times(read("times"))
    draw_speed()


def read(name: str) -> list[dict[str, str]]:
    """Read the rows of a table."""
    with (DOCS / "results" / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def draw_speed() -> None:
    """Plot correct matches against the time relative to SIFT, on Oxford and on HPatches."""
    oxford = {f"{row['method']}|{row['descriptors']}": row for row in read("times")}
    described = {row["descriptors"]: row for row in read("descriptors")}
    unit = float(oxford["SIFT|own"][TIME])
    tables = {
        "Oxford, 40 pairs, ratio test": {
            title: (float(oxford[name][TIME]) / unit, float(oxford[name]["right at 3 px"]))
            for name, title in SHOWN["times"].items()
        },
    }
    for panel, columns in DESCRIBED.items():
        tables[panel] = {
            title: (
                float(described[name]["time"]),
                float(np.mean([float(described[name][column]) for column in columns])),
            )
            for name, title in SHOWN["descriptors"].items()
        }
    figure, panels = pyplot.subplots(1, 3, figsize=(14, 4), layout="constrained")
    for axes, (title, places) in zip(panels, tables.items(), strict=True):
        for name, (x, y) in places.items():
            ours = name.startswith(("points", "best dense"))
            axes.plot(x, y, "o", color="C3" if ours else "C0", markersize=9 if ours else 6)
            style = {"xytext": (8, 0), "textcoords": "offset points", "va": "center"}
            style |= {"weight": "bold" if ours else "normal", "fontsize": "small"}
            axes.annotate(name, (x, y), **(style | MOVED.get(name, {})))
        axes.set(
            title=title, xscale="log", xlabel="CPU time of an image, one thread; OpenCV's SIFT = 1"
        )
        axes.set(xlim=SPEED_X, ylabel="correct matches of a pair, within 3 px")
        axes.set_ylim(0, 1.1 * max(y for _, y in places.values()))
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    figure.savefig(DOCS / "images" / "speed.png", dpi=90, metadata={"Software": None})


def draw_times(rows: list[dict[str, str]]) -> None:
    """Plot a panel for each measure, with a colour per method and a marker per descriptor."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    figure, panels = pyplot.subplots(1, len(PANELS), figsize=(13, 4.6), layout="constrained")
    for axes, (measure, title) in zip(panels, PANELS.items(), strict=True):
        for row in rows:
            k = methods.index(row["method"])
            ours = row["method"].startswith(("points", "dense"))
            axes.plot(
                float(row[TIME]),
                float(row[measure]),
                MARKERS[row["descriptors"]],
                color=f"C{k}" if k < 10 else "black",
                markersize=10 if ours else 6,
                markeredgecolor="black" if ours else "none",
            )
        axes.set(title=title, xlabel="ms, one thread", xscale="log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter("{x:g}")
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    colours = [("s", f"C{k}" if k < 10 else "black", name) for k, name in enumerate(methods)]
    marks = [(mark, "grey", f"descriptors: {name}") for name, mark in MARKERS.items()]
    handles = [
        pyplot.Line2D([], [], marker=mark, color=colour, linestyle="", label=name)
        for mark, colour, name in colours + marks
    ]
    figure.legend(handles=handles, loc="outside right center", fontsize="small")
    figure.savefig(DOCS / "images" / "times.png", dpi=90, metadata={"Software": None})


if __name__ == "__main__":
    main()
