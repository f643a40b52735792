"""Compare local features, and chance baselines, on image pairs with homographies.

All methods are compared at equal numbers of keypoints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from deepdetect.features.keypoints import Keypoints
from deepdetect.geometry import GeometryOptions, estimate_geometry

from ...datasets.planar import PlanarPair
from ..baselines.method import LocalFeature
from ..metrics.homography import (
    CORNER_THRESHOLDS_PX,
    accuracy_at,
    area_under_curve,
    corner_error,
    match_accuracy,
)
from ..metrics.repeatability import mutual_nn_repeatability
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
    mean,
    tabulate,
    where,
)
from ..run import MatchSettings, Run

BUDGETS: tuple[int | None, ...] = (512, 1024, 2048, 4096, 8192, None)
"""Numbers of best keypoints per image at which methods are compared. None takes all keypoints."""

RADII_PX = (1.0, 2.0, 3.0)
SEEDS = 5
MATCHING_BUDGET = 2048
RATIO = 0.85
"""Threshold of the ratio test for descriptors that are not learned. Chosen by hand."""

INLIER_THRESHOLD_PX = 3.0

MIN_FILLED = 0.9
"""A result at a budget is only shown if the method finds, on average, at least this fraction of the
budget, because otherwise the numbers of keypoints would differ between methods. Chosen by hand."""

MAX_CHANCE = 0.95
"""Repeatability is not corrected for chance above this chance level, because the correction divides
by 1 - chance. Chosen by hand."""

MATCHING_NOTE = (
    f"The best {MATCHING_BUDGET:,} keypoints of each image are matched by mutual nearest "
    f"neighbours with ratio {RATIO}, or without ratio test if descriptors are learned. All methods "
    "have the same descriptor, upright RootSIFT of size 4, except in rows whose names say "
    "otherwise. Values are means over the pairs; the precision of a pair without matches is 0."
)


def standard_sections(
    run: Run,
    options: BenchmarkOptions,
    pairs: Sequence[PlanarPair],
    key: str,
    title: str,
    text: str,
) -> list[Section]:
    """Measure all features on all pairs, and tabulate them, if "standard" is requested."""
    if "standard" not in options.protocols:
        return []
    features = options.standard_features()
    rows = standard_rows(run, features, pairs)
    tables = standard_tables(features, rows, key, f"{title} ({len(pairs)} pairs)")
    return [Section(f"{title}, the standard protocol", (text,), tables)]


def standard_rows(run: Run, features: Sequence[LocalFeature], pairs: Sequence[PlanarPair]) -> Rows:
    """Measure each feature on each pair; a row has the values of `pair_row`."""
    items = {pair.name: pair for pair in pairs}
    return run.rows("", features, items, lambda feature, pair: pair_row(run, feature, pair))


def pair_row(run: Run, feature: LocalFeature, pair: PlanarPair) -> Row:
    """Measure a feature on an image pair.

    Returns:
        Values by name. "kind": kind of change in the pair. ("keypoints", budget): number of
        keypoints in the image that has fewer. ("repeated", budget, radius), ("chance", budget,
        radius) and ("localization", budget, radius): the values of `mutual_nn_repeatability`.
        "matches", ("correct", px), ("precision", px) and ("score", px): the values of
        `match_accuracy`. "corner errors": a list with the corner error for each seed of MAGSAC.
    """
    images = (pair.first, pair.second)
    first, second = (run.keypoints(feature, image)[0] for image in images)
    sizes = first.image_size, second.image_size
    ratio = math.inf if feature.learned else RATIO
    settings = MatchSettings("exact", ratio, mutual=True, budget=MATCHING_BUDGET)
    matches = run.matches(feature, images, settings)
    points = matches.points0, matches.points1
    keypoints = matches.keypoints0, matches.keypoints1

    def corner_errors() -> Row:
        options = GeometryOptions(inlier_threshold=INLIER_THRESHOLD_PX)
        estimated = [
            estimate_geometry(*points, "homography", seed=seed, options=options).matrix
            for seed in range(SEEDS)
        ]
        return {"errors": [corner_error(each, pair.homography, sizes[0]) for each in estimated]}

    depends = (*feature.key, images, pair.homography, settings, (INLIER_THRESHOLD_PX, SEEDS))
    row: Row = {
        "kind": pair.kind,
        **match_accuracy(*points, *keypoints, pair.homography, sizes),
        "corner errors": run.cached("corner_errors", depends, corner_errors)["errors"].tolist(),
    }
    # SIFT repeats some positions with other orientations. For repeatability a position counts once.
    places = [first.distinct(), second.distinct()]
    for budget in BUDGETS:
        row |= _at_budget(run, feature, pair, places, budget)
    return row


def _at_budget(
    run: Run,
    feature: LocalFeature,
    pair: PlanarPair,
    places: Sequence[Keypoints],
    budget: int | None,
) -> Row:
    first, second = (each if budget is None else each.best(budget) for each in places)
    sizes = first.image_size, second.image_size

    def make() -> Row:
        found = mutual_nn_repeatability(first.xy, second.xy, pair.homography, sizes, RADII_PX)
        return {"rows": found}

    depends = (feature.detection, (pair.first, pair.second), pair.homography, budget, RADII_PX)
    rows = run.cached("repeatability_mutual_nn", depends, make)["rows"].tolist()
    row: Row = {("keypoints", budget): min(len(first), len(second))}
    for radius, values in zip(RADII_PX, rows, strict=True):
        for name, value in zip(("repeated", "chance", "localization"), values, strict=True):
            row[name, budget, radius] = value
    return row


def repeated(rows: Rows, budget: int | None, radius: float, name: str = "repeated") -> float | None:
    """Return the mean of a value of `pair_row` over the rows, by default of the repeatability.

    It is None if there are fewer keypoints than `MIN_FILLED` times the budget on average.
    """
    filled = mean(rows, ("keypoints", budget))
    if filled is None or (budget is not None and filled < MIN_FILLED * budget):
        return None
    return mean(rows, (name, budget, radius))


def correct(rows: Rows) -> float | None:
    """Return the mean number of matches with an error of at most 1 px."""
    return mean(rows, ("correct", 1))


def budget_name(budget: int | None) -> str:
    """Return the name of a budget in tables."""
    return "all" if budget is None else f"{budget:,}"


def standard_tables(
    features: Sequence[LocalFeature], rows: Rows, key: str, what: str
) -> list[Table]:
    """Tabulate the rows. `key` begins the keys of the tables; `what` names the data in titles."""
    tables: list[tuple[str, str, Columns, str]] = [
        (
            f"repeatability_{radius:g}px",
            f"Mutual-NN repeatability within {radius:g} px, {what}",
            _repeatability_columns(radius),
            REPEATABILITY_NOTE,
        )
        for radius in RADII_PX
    ]
    if kinds := list(dict.fromkeys(row["kind"] for row in rows if row["kind"])):
        tables.append(("kinds", f"By kind of pair, {what}", _kind_columns(kinds), KIND_NOTE))
    tables += [
        ("matching", f"Matches, {what}", MATCHING_COLUMNS, MATCHING_NOTE),
        ("homography", f"Homographies, {what}", _homography_columns(), HOMOGRAPHY_NOTE),
    ]
    return [
        tabulate(f"{key}_{name}", title, features, rows, {**PAIRS, **columns}, note)
        for name, title, columns, note in tables
    ]


def _repeatability_columns(radius: float) -> Columns:
    def corrected(own: Rows, budget: int | None) -> Cell:
        value, chance = (repeated(own, budget, radius, name) for name in ("repeated", "chance"))
        if value is None or chance is None or chance > MAX_CHANCE:
            return None
        return (value - chance) / (1 - chance)

    columns: dict[str, tuple[str, Measure]] = {}
    for budget in BUDGETS:
        of, name = partial(repeated, budget=budget, radius=radius), budget_name(budget)
        columns[name] = ".3f", of
        columns[f"{name}: chance"] = ".3f", partial(of, name="chance")
        columns[f"{name}: chance-corrected"] = ".3f", partial(corrected, budget=budget)
    localization = ("localization", MATCHING_BUDGET, radius)
    columns["keypoints of all"] = average(",.0f", ("keypoints", None))
    columns[f"localization at {MATCHING_BUDGET:,}, px"] = average(".2f", localization)
    return columns


def _kind_columns(kinds: Sequence[str]) -> Columns:
    def of_kind(own: Rows, kind: str, cell: Measure) -> Cell:
        return cell(where(own, kind=kind))

    values: dict[str, tuple[str, Measure]] = {
        f"@{radius:g} px": (".3f", partial(repeated, budget=MATCHING_BUDGET, radius=radius))
        for radius in (RADII_PX[0], RADII_PX[-1])
    }
    return {
        f"{kind}: {title}": (style, partial(of_kind, kind=kind, cell=cell))
        for kind in kinds
        for title, (style, cell) in {**values, "correct": (",.0f", correct)}.items()
    }


def _homography_columns() -> Columns:
    def over_seeds(
        own: Rows, metric: Callable[[Sequence[float], float], float], px: float, spread: bool
    ) -> Cell:
        if not own:
            return None
        seeds = zip(*(row["corner errors"] for row in own), strict=True)
        values = [metric(errors, px) for errors in seeds]
        return float(np.std(values, ddof=1) if spread else np.mean(values))

    return {
        title.format(name, px): (".3f", partial(over_seeds, metric=metric, px=px, spread=spread))
        for name, metric in (("accuracy", accuracy_at), ("AUC", area_under_curve))
        for px in CORNER_THRESHOLDS_PX
        for title, spread in (("{} at {:g} px", False), ("± of {} {:g}", True))
    }


PAIRS: Columns = {"pairs": (",d", len)}

MATCHING_COLUMNS: Columns = {
    "keypoints": average(",.0f", ("keypoints", MATCHING_BUDGET)),
    "matches": average(",.0f", "matches"),
    **{
        f"{title} at {px} px": average(style, (name, px))
        for title, style, name in (
            ("correct", ",.0f", "correct"),
            ("precision", ".3f", "precision"),
            ("matching score", ".3f", "score"),
        )
        for px in (1, 3)
    },
}

REPEATABILITY_NOTE = (
    "The columns are numbers of best keypoints per image (budgets). Repeatability: number of pairs "
    "of keypoints that are mutual nearest neighbours and at most the radius apart, divided by the "
    "smaller number of keypoints in the overlap of the images; mean over the image pairs. Several "
    "keypoints at one position count once. Chance: repeatability of as many random points. "
    "Chance-corrected: 0 is as good as chance, and 1 means that all keypoints are repeated; a dash "
    f"if chance is over {MAX_CHANCE:.0%}. All three are dashes if a method finds under "
    f"{MIN_FILLED:.0%} of the budget. Localization: mean distance in such pairs of keypoints."
)

KIND_NOTE = (
    "For each kind of change between the two images: mutual-NN repeatability within two radii, and "
    f"number of correct matches within 1 px, with the best {MATCHING_BUDGET:,} keypoints. Values "
    "are means over the pairs of a kind."
)

HOMOGRAPHY_NOTE = (
    f"{MATCHING_NOTE} MAGSAC estimates a homography from the matches, with an inlier threshold of "
    f"{INLIER_THRESHOLD_PX:g} px. Error: the corners of the first image are mapped by the "
    "estimated and by the true homography, and the error is their mean distance in pixels of the "
    "second image; it is infinite for pairs without an estimate. Accuracy: fraction of the pairs "
    "with an error up to a threshold; AUC: area under the curve of this fraction, as in SuperGlue. "
    f"Values are means over {SEEDS} seeds of MAGSAC; ± is the standard deviation over the seeds."
)
