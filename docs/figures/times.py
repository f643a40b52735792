"""The picture of docs/results/times.csv: what is found again and matched, against the time.

python docs/figures/times.py    # writes docs/images/times.png
"""

from __future__ import annotations

import csv
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
from matplotlib import pyplot
from matplotlib.ticker import LogLocator

DOCS = Path(__file__).parents[1]
PANELS = {
    "@1": "found again within 1 px, one to one",
    "@3": "found again within 3 px, one to one",
    "right at 3 px": "right matches of a pair, within 3 px",
}
MARKERS = {"own": "o", "RootSIFT": "s", "own size and angle": "^"}
TIME = "1 thread, ms"


def main() -> None:
    """Draw a panel for each measure, a colour for each method, a mark for each descriptor."""
    with (DOCS / "results" / "times.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
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
