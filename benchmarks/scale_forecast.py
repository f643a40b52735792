"""What collections of usual photographs take, on paper, by what was measured of smaller ones.

    python benchmarks/scale_forecast.py

CPU hours and gigabytes for photographs of 1600x1067 with 2,048 points, by docs/results: the costs
of one image and pair, with all that each takes in a made collection on a Ray cluster added
(`scale.csv`), and the mappers' times on made flights (`mappers.csv`), up to ten times the largest.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from deepdetect_lab.evaluation.report import Table

RESULTS = Path(__file__).parents[1] / "docs" / "results"

COUNTS = (1000, 10_000, 100_000, 1_000_000)
SIZE, POINTS = "1600x1067", 2048
MADE_POINTS = 256
"""Of an image in `scale.csv`."""

POINT_BYTES, MATCH_BYTES = 279, 8
"""In files, of a point with a learned descriptor, and of a point in each pair."""

MIN_MAPPED, FARTHEST = 120, 10
"""Images from which on the time of the mapping tells how it grows, and how far it is told."""

COLUMNS = {
    "images": ",d",
    "features, h": ",.1f",
    "similar pairs, h": ",.1f",
    "matching, h": ",.1f",
    "incremental mapper, h": ",.1f",
    "global mapper, h": ",.1f",
    "memory, GB": ",.1f",
    "files, GB": ",.0f",
}


def read_result(name: str) -> list[dict[str, float | str]]:
    """Read a table of docs/results, with numbers where these are."""
    with (RESULTS / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return [{key: number(cell) for key, cell in row.items()} for row in csv.DictReader(file)]


def number(cell: str) -> float | str:
    """Return a cell as a number, if it is one."""
    try:
        return float(cell)
    except ValueError:
        return cell


def growth(made: list[dict[str, float | str]], values: list[float]) -> tuple[float, float]:
    """Return how much a value grows by an image, and what it is of none, by the two largest."""
    slope, constant = np.polyfit([row["images"] for row in made[-2:]], values[-2:], 1)
    return max(0.0, float(slope)), float(constant)


def forecast() -> list[dict[str, float | None]]:
    """Return the rows of the table."""
    made = read_result("scale")
    last = made[-1]
    costs = next(row for row in read_result("costs") if row["image, px"] == SIZE)
    image_s = costs[f"{POINTS} points, s"] + last["features, CPU s an image"]
    pair_s = costs["matching these, s"] + last["matching, CPU s a pair"]
    pairs_an_image = last["pairs"] / last["images"]
    # Each image is compared with all others; its own vector is of eight times the points.
    compared_s, own_s = growth(made, [row["similar pairs, CPU s an image"] for row in made])
    own_s = max(0.0, own_s) * POINTS / MADE_POINTS
    stages = ("features, MB", "similar pairs, MB", "matching, MB")
    memories = [growth(made, [row[stage] for row in made]) for stage in stages]
    written = last["images"] * POINT_BYTES * MADE_POINTS + last["pairs"] * MATCH_BYTES * MADE_POINTS
    other_bytes = (last["files, MB"] * 1e6 - written) / last["images"]
    powers = {}
    for mapper in ("incremental", "global"):
        known = [row for row in read_result("mappers") if row["mapper"] == mapper]
        times = np.array([(row["images"], row["CPU s"]) for row in known])
        fit = np.polyfit(*np.log(times[times[:, 0] >= MIN_MAPPED]).T, 1)
        powers[mapper] = fit, FARTHEST * times[:, 0].max()
    rows = []
    for count in COUNTS:
        pairs = count * pairs_an_image
        size = POINTS * (count * POINT_BYTES + pairs * MATCH_BYTES) + count * other_bytes
        row: dict[str, float | None] = {
            "images": count,
            "features, h": count * image_s / 3600,
            "similar pairs, h": count * (own_s + compared_s * count) / 3600,
            "matching, h": pairs * pair_s / 3600,
            "memory, GB": max(slope * count + constant for slope, constant in memories) / 1e3,
            "files, GB": size / 1e9,
        }
        for mapper, (fit, farthest) in powers.items():
            told = float(np.exp(np.polyval(fit, np.log(count)))) / 3600
            row[f"{mapper} mapper, h"] = told if count <= farthest else None
        rows.append(row)
    return rows


if __name__ == "__main__":
    print(Table("forecast", "", COLUMNS, forecast()).to_markdown())
