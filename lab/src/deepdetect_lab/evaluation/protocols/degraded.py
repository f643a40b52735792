"""The standard metrics if one image is dark or blurred, relative to daylight."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from deepdetect._shared.records import file_digest
from deepdetect.io.image import load_image
from deepdetect.io.picture_file import save_picture

from ...datasets.degradation import DEGRADATIONS, Degradation, degrade
from ...datasets.planar import PlanarPair
from ..baselines.method import LocalFeature
from ..metrics.homography import accuracy_at
from ..options import BenchmarkOptions
from ..report import (
    Cell,
    Columns,
    Measure,
    Row,
    Rows,
    Section,
    Table,
    average,
    mean_of,
    tabulate,
    where,
)
from ..run import Run
from .standard import MATCHING_BUDGET, PAIRS, RADII_PX, budget_name, correct, pair_row, repeated

BUDGETS = (512, MATCHING_BUDGET, 8192)
HOMOGRAPHY_THRESHOLD_PX = 3.0
DAYLIGHT = "daylight"

TEXT = (
    "Dark and blurred image copies are simulated in linear light with fixed random numbers. "
    "With 1/4 or 1/8 of the light, white gives 2,500 or 1,250 electrons instead of 10,000. "
    "Shot noise is Poisson noise, read noise has a standard deviation of 3 electrons, and the "
    "result has 8 bits. The direction of motion blur is random for each image. Only the second "
    "image of each pair is degraded."
)

OVERVIEW_NOTE = (
    f"Score divided by the score of the same pairs in daylight, at {MATCHING_BUDGET:,} keypoints: "
    "mutual-NN repeatability, and correct matches at 1 px. A dash means that a method does not "
    "find enough keypoints."
)

NOTE = (
    "Metrics as in the standard protocol. 'of daylight' means divided by the score of the same "
    "pairs in daylight. A dash means that a method finds too few keypoints. Keypoints: number in "
    "the image that has fewer."
)

Score = Callable[[Rows], float | None]

VALUES: tuple[tuple[str, int, str, Score], ...] = (
    *(
        (f"@{radius:g} px", budget, ".3f", partial(repeated, budget=budget, radius=radius))
        for radius in (RADII_PX[0], RADII_PX[-1])
        for budget in BUDGETS
    ),
    ("correct at 1 px", MATCHING_BUDGET, ",.0f", correct),
)
"""Title, keypoint budget, number format and function of each compared score."""


def degraded_sections(
    run: Run, options: BenchmarkOptions, pairs: Sequence[PlanarPair], key: str, title: str
) -> list[Section]:
    """Measure and show all features of the standard protocol on all pairs."""
    if "degraded" not in options.protocols:
        return []
    features = options.standard_features()
    rows = degraded_rows(run, features, pairs)
    tables = degraded_tables(features, rows, f"{key}_degraded", f"{title} ({len(pairs)} pairs)")
    return [Section(f"{title}, dark and blurred", (TEXT,), tables)]


def degraded_rows(run: Run, features: Sequence[LocalFeature], pairs: Sequence[PlanarPair]) -> Rows:
    """Measure all features on all pairs, in daylight and with each degradation.

    Returns the rows of `standard.pair_row` with "light" and "daylight", the row of the same pair in
    daylight. Pairs that failed in either of the two have no row.
    """
    lights = (DAYLIGHT, *DEGRADATIONS)
    items = {f"{pair.name}, {light}": (light, pair) for light in lights for pair in pairs}

    def measure(feature: LocalFeature, item: tuple[str, PlanarPair]) -> Row:
        light, pair = item
        if light != DAYLIGHT:
            pair = degraded_pair(pair, DEGRADATIONS[light], run.files_folder)
        return {"light": light, "pair": pair.name, **pair_row(run, feature, pair, BUDGETS)}

    rows = run.rows("", features, items, measure)
    daylight = {(r["method"], r["pair"]): r for r in rows if r["light"] == DAYLIGHT}
    return [
        row | {"daylight": daylight[row["method"], row["pair"]]}
        for row in rows
        if row["light"] != DAYLIGHT and (row["method"], row["pair"]) in daylight
    ]


def degraded_pair(pair: PlanarPair, degradation: Degradation, folder: Path) -> PlanarPair:
    """Return a pair whose second image is a degraded copy, which a folder holds."""
    return replace(pair, second=degraded_copy(pair.second, degradation, folder))


def degraded_copy(image: Path, degradation: Degradation, folder: Path) -> Path:
    """Return the PNG file of a degraded copy of an image; create it if it is missing."""
    digest = file_digest(image)[:16]
    path = folder / "degraded" / f"{digest}-{degradation.name}-v{degradation.version}.png"
    if not path.exists():
        save_picture(degrade(load_image(image), degradation), path)
    return path


def degraded_tables(
    features: Sequence[LocalFeature], rows: Rows, key: str, what: str
) -> list[Table]:
    """Tabulate the scores relative to daylight, and the scores with each degradation."""
    overview: Columns = {
        f"{degradation.title}: {title}": (".0%", partial(_relative, light=light, value=value))
        for light, degradation in DEGRADATIONS.items()
        for title, budget, _, value in VALUES
        if budget == MATCHING_BUDGET
    }
    title = f"Dark and blurred: fraction of the score in daylight, {what}"
    tables = [tabulate(f"{key}_relative", title, features, rows, overview, OVERVIEW_NOTE)]
    for light, degradation in DEGRADATIONS.items():
        columns: dict[str, tuple[str, Measure]] = {**PAIRS}
        for name, budget, style, value in VALUES:
            name = f"{name}, {budget_name(budget)}"
            columns[name] = style, value
            columns[f"{name}: of daylight"] = ".0%", partial(_relative, light=light, value=value)
        columns[f"homography at {HOMOGRAPHY_THRESHOLD_PX:g} px"] = ".3f", _homography_accuracy
        most = BUDGETS[-1]
        columns[f"keypoints, of at most {most:,}"] = average(",.0f", ("keypoints", most))
        title, own = f"{degradation.title}, {what}", where(rows, light=light)
        tables.append(tabulate(f"{key}_{light}", title, features, own, columns, NOTE))
    return tables


def _homography_accuracy(own: Rows) -> Cell:
    return mean_of(accuracy_at(row["corner errors"], HOMOGRAPHY_THRESHOLD_PX) for row in own)


def _relative(rows: Rows, light: str, value: Score) -> Cell:
    """Return a score in a given light divided by the score of the same pairs in daylight."""
    own = where(rows, light=light)
    degraded, daylight = value(own), value([row["daylight"] for row in own])
    return degraded / daylight if degraded is not None and daylight else None
