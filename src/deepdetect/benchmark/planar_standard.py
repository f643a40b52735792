"""The field's measures on scenes with homographies, at equal budgets and beside chance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..datasets.planar import PlanarPair
from ..geometry import GeometryOptions, estimate_geometry
from ..methods import Method
from ..metrics.homography_accuracy import area_under_curve, corner_error, share_within
from ..metrics.match_accuracy import MatchAccuracy, match_accuracy, mean_matching_accuracy
from ..metrics.one_to_one import Repeatability, one_to_one_repeatability
from ..metrics.spread import coverage
from .report import Cell, Column, Figure, Table
from .stages import FoundMatches, MatchSettings
from .workspace import Workspace, image_size, matrix_key

BUDGETS: tuple[int | None, ...] = (512, 1024, 2048, 4096, 8192, None)
RADII = (1.0, 2.0, 3.0)
CORNERS = (1.0, 3.0, 5.0)
SEEDS = 5
MATCHING_BUDGET = 2048
RATIO = 0.85
INLIER_THRESHOLD = 3.0


@dataclass(frozen=True)
class StandardResult:
    """What one method gives on some pairs; the lists are by pair.

    Attributes:
        repeatability: by budget, the results at each radius of each pair.
        coverage: by budget, of the first image of each pair.
        accuracy: of the matches.
        corner_errors: by seed, in pixels.
        seconds, memory: by stage; the median, and the largest growth in bytes.
    """

    method: Method
    repeatability: Mapping[int | None, list[list[Repeatability]]]
    coverage: Mapping[int | None, list[float]]
    accuracy: list[MatchAccuracy]
    corner_errors: list[list[float]]
    seconds: Mapping[str, float]
    memory: Mapping[str, int]


def measure(
    workspace: Workspace,
    method: Method,
    pairs: Sequence[PlanarPair],
    budgets: Sequence[int | None] = BUDGETS,
) -> StandardResult:
    """Measure a method on pairs; a pair that fails is left out and noted.

    Each pair is one step of the workspace's progress.
    """
    repeatability: dict[int | None, list[list[Repeatability]]] = {b: [] for b in budgets}
    covered: dict[int | None, list[float]] = {budget: [] for budget in budgets}
    accuracy, errors, found_matches, detecting = [], [], [], []
    for pair in pairs:
        workspace.done(0, f"{method.name}, {pair.name}")
        found = workspace.attempt(
            f"{method.title} on {pair.name}",
            _measure_pair,
            workspace,
            method,
            pair,
            budgets,
        )
        workspace.done(1, f"{method.name}, {pair.name}")
        if found is None:
            continue
        by_budget, cover, matches, judged, corner = found
        for budget in budgets:
            repeatability[budget].append(by_budget[budget])
            covered[budget].append(cover[budget])
        accuracy.append(judged)
        errors.append(corner)
        found_matches.append(matches)
        detecting += [workspace.keypoints(method, image) for image in (pair.first, pair.second)]
    seconds, memory = {}, {}
    for stage, timed in (
        ("detect", detecting),
        ("describe", [matches.describing for matches in found_matches]),
        ("match", found_matches),
    ):
        seconds[stage] = float(np.median([t.seconds for t in timed])) if timed else float("nan")
        memory[stage] = max((t.memory for t in timed), default=0)
    by_seed = [list(values) for values in zip(*errors, strict=True)]
    return StandardResult(method, repeatability, covered, accuracy, by_seed, seconds, memory)


def _measure_pair(
    workspace: Workspace,
    method: Method,
    pair: PlanarPair,
    budgets: Sequence[int | None],
) -> tuple[
    dict[int | None, list[Repeatability]],
    dict[int | None, float],
    FoundMatches,
    MatchAccuracy,
    list[float],
]:
    images = (pair.first, pair.second)
    sizes = (image_size(pair.first), image_size(pair.second))
    by_budget, cover = {}, {}
    for budget in budgets:
        by_budget[budget] = _repeatability(workspace, method, pair, sizes, budget)
        cover[budget] = _coverage(workspace, method, pair, sizes, budget)
    settings = MatchSettings(
        "exact", 1.0 if method.learned else RATIO, mutual=True, budget=MATCHING_BUDGET
    )
    matches = workspace.matches(method, pair, settings)
    judged = match_accuracy(
        matches.points0,
        matches.points1,
        matches.keypoints0,
        matches.keypoints1,
        pair.homography,
        sizes,
    )

    def make() -> dict[str, np.ndarray]:
        errors = [
            corner_error(
                estimate_geometry(
                    matches.points0,
                    matches.points1,
                    GeometryOptions(
                        model="homography", inlier_threshold=INLIER_THRESHOLD, seed=seed
                    ),
                ).matrix,
                pair.homography,
                sizes[0],
            )
            for seed in range(SEEDS)
        ]
        return {"errors": np.array(errors)}

    depends = {"homography": matrix_key(pair.homography), "settings": vars(settings)}
    corner = workspace.metric("corner errors 1", method, images, depends, make)["errors"].tolist()
    return by_budget, cover, matches, judged, corner


def _repeatability(
    workspace: Workspace,
    method: Method,
    pair: PlanarPair,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    budget: int | None,
) -> list[Repeatability]:
    images = (pair.first, pair.second)

    def make() -> dict[str, np.ndarray]:
        points = [_best(workspace, method, image, budget) for image in images]
        found = one_to_one_repeatability(*points, pair.homography, sizes, RADII)
        rows = [(e.radius, e.repeated, e.fewest, e.localisation, e.chance) for e in found]
        return {"rows": np.array(rows, np.float64)}

    depends = {"homography": matrix_key(pair.homography), "budget": budget}
    rows = workspace.metric("one-to-one repeatability 1", method, images, depends, make)["rows"]
    return [Repeatability(r, int(n), int(f), away, chance) for r, n, f, away, chance in rows]


def _coverage(
    workspace: Workspace,
    method: Method,
    pair: PlanarPair,
    sizes: tuple[tuple[int, int], tuple[int, int]],
    budget: int | None,
) -> float:
    def make() -> dict[str, np.ndarray]:
        points = _best(workspace, method, pair.first, budget)
        return {"value": np.array(coverage(points, sizes[0]))}

    found = workspace.metric("coverage 1", method, (pair.first,), {"budget": budget}, make)
    return float(found["value"])


def _best(workspace: Workspace, method: Method, image: Path, budget: int | None) -> np.ndarray:
    features = workspace.keypoints(method, image).features
    return (features if budget is None else features.best(budget)).xy


def _name(budget: int | None) -> str:
    return "all" if budget is None else f"{budget:,}"


def repeatability_tables(results: Sequence[StandardResult], key: str, what: str) -> list[Table]:
    """Tabulate the one-to-one repeatability at each radius, and the localisation error."""
    tables = []
    for k, radius in enumerate(RADII):
        columns = [Column("method")]
        for budget in results[0].repeatability:
            columns += [
                Column(_name(budget), ".3f"),
                Column(f"{_name(budget)}: above chance", ".3f"),
            ]
        columns += [Column("all: points", ",d"), Column("2,048: localisation, px", ".2f")]
        rows: list[tuple[Cell, ...]] = []
        for result in results:
            cells: list[Cell] = [result.method.title]
            for entries in result.repeatability.values():
                at = [entry[k] for entry in entries]
                cells += [_mean([e.value for e in at]), _mean([e.corrected for e in at])]
            last = [entry[k] for entry in result.repeatability.get(None, [])]
            middle = [entry[k] for entry in result.repeatability.get(MATCHING_BUDGET, [])]
            points = _mean([e.fewest for e in last])
            cells.append(None if points is None else round(points))
            cells.append(_mean([e.localisation for e in middle if e.repeated]))
            rows.append(tuple(cells))
        note = (
            "Pairs of keypoints that are each other's nearest, at most the radius apart, over the "
            "fewer of the keypoints that both images show; by number of keypoints in each image, "
            "mean over the pairs. Above chance: 0 is what random points reach, 1 is all."
        )
        title = f"Repeatability one to one within {radius:g} px, {what}"
        tables.append(
            Table(f"{key}_repeatability_{radius:g}px", title, tuple(columns), tuple(rows), note)
        )
    return tables


def matching_table(results: Sequence[StandardResult], key: str, what: str) -> Table:
    """Tabulate matches and the homographies from them."""
    columns = (
        Column("method"),
        Column("matches", ",.0f"),
        *(Column(f"correct at {t} px", ",.0f") for t in (1, 3)),
        Column("precision at 1 px", ".3f"),
        Column("precision at 3 px", ".3f"),
        Column("matching score at 3 px", ".3f"),
        *(Column(f"corners within {t:g} px", ".3f") for t in CORNERS),
        *(Column(f"AUC at {t:g} px", ".3f") for t in CORNERS),
        Column("spread of AUC at 3 px", ".3f"),
    )
    rows: list[tuple[Cell, ...]] = []
    for result in results:
        seeds = result.corner_errors
        rows.append(
            (
                result.method.title,
                _mean([judged.matches for judged in result.accuracy]),
                *(_mean([judged.correct[t - 1] for judged in result.accuracy]) for t in (1, 3)),
                *(_mean([judged.precision(t) for judged in result.accuracy]) for t in (1, 3)),
                _mean([judged.matching_score(3) for judged in result.accuracy]),
                *(_mean([share_within(errors, t) for errors in seeds]) for t in CORNERS),
                *(_mean([area_under_curve(errors, t) for errors in seeds]) for t in CORNERS),
                float(np.std([area_under_curve(errors, 3.0) for errors in seeds]))
                if seeds
                else None,
            )
        )
    note = (
        f"The best {MATCHING_BUDGET:,} keypoints of each image; the same upright RootSIFT of size "
        "4 for all, but for methods with descriptors of their own; mutual nearest neighbours, "
        f"ratio {RATIO} (none for learned descriptors); MAGSAC at {INLIER_THRESHOLD:g} px, mean "
        f"of {SEEDS} seeds. Means over the pairs; a pair without a homography counts as wrong."
    )
    return Table(f"{key}_matching", f"Matches and homographies, {what}", columns, tuple(rows), note)


def accuracy_table(results: Sequence[StandardResult], key: str, what: str) -> Table:
    """Tabulate the mean matching accuracy at 1 to 10 px."""
    columns = (Column("method"), *(Column(f"{t} px", ".3f") for t in range(1, 11)))
    rows = tuple(
        (result.method.title, *mean_matching_accuracy(result.accuracy))
        for result in results
        if result.accuracy
    )
    note = "Share of the matches that are at most so far off, mean over the pairs."
    return Table(f"{key}_accuracy", f"Mean matching accuracy, {what}", columns, rows, note)


def cost_table(results: Sequence[StandardResult], key: str) -> Table:
    """Tabulate coverage, seconds and memory."""
    stages = ("detect", "describe", "match")
    budgets = list(results[0].coverage)
    columns = (
        Column("method"),
        *(Column(f"coverage, {_name(budget)}", ".3f") for budget in budgets),
        *(Column(f"{stage}, s", ".3f") for stage in stages),
        *(Column(f"{stage}, MB", ",.0f") for stage in stages),
    )
    rows = tuple(
        (
            result.method.title,
            *(_mean(values) for values in result.coverage.values()),
            *(result.seconds[stage] for stage in stages),
            *(result.memory[stage] / 1e6 for stage in stages),
        )
        for result in results
    )
    note = (
        "Coverage: share of the cells of 32x32 px that hold a keypoint. Seconds: the median; "
        "detecting of one image, describing of both, matching of the pair at "
        f"{MATCHING_BUDGET:,} keypoints, measured when the result was made. Memory: the largest "
        "growth of the process."
    )
    return Table(f"{key}_cost", "Coverage, time and memory", columns, rows, note)


def accuracy_figure(results: Sequence[StandardResult], key: str, what: str) -> Figure:
    """Draw the mean matching accuracy."""
    from .charts import line_chart

    lines = {
        result.method.title: (range(1, 11), mean_matching_accuracy(result.accuracy))
        for result in results
        if result.accuracy
    }
    png = line_chart(lines, "error up to, px", "mean matching accuracy")
    return Figure(f"{key}_accuracy", f"Mean matching accuracy, {what}", png)


def _mean(values: Sequence[float]) -> float | None:
    finite = [value for value in values if value == value]
    return float(np.mean(finite)) if finite else None
