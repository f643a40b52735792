"""The standard metrics where one image is dark or blurred, beside those in daylight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from ..._shared.atomic import atomic_path
from ..._shared.opencv import cv2
from ...datasets.degradation import DEGRADATIONS, Degradation, degrade
from ...datasets.types import PlanarPair
from ...io.image import load_image
from ..baselines.method import LocalFeature
from ..cache import file_digest
from ..context import BenchmarkContext
from ..metrics.homography import accuracy_at
from ..options import DegradedImages
from ..report import Cell, Column, Table
from ..tasks import Part, Shown, feature_part
from .standard import measure_pair
from .standard_results import (
    MATCHING_BUDGET,
    RADII_PX,
    Columns,
    FeatureResult,
    PairResult,
    budget_name,
    tabulate,
)

DEGRADED_BUDGETS = (512, MATCHING_BUDGET, 8192)
HOMOGRAPHY_THRESHOLD_PX = 3.0
DAYLIGHT = "daylight"

DEGRADED_TEXT = (
    "Dark and blurred copies of the same photographs, made at run time in linear light, with the "
    "same random numbers every time. In 1/4 or 1/8 of the light (same exposure and gain) white "
    "gives 2,500 or 1,250 electrons instead of 10,000; shot noise is Poisson's, reading adds 3 "
    "electrons (standard deviation), and the result has 8 bits. Motion blur goes in a direction "
    "drawn for each image. The true homographies are those of the photographs."
)

WHICH_TEXT: dict[DegradedImages, str] = {
    "second": (
        "The second image of each pair is degraded, the first is not: what is found must be found "
        "in spite of the change, as when a place is recognised at dusk by a map made at noon."
    ),
    "both": (
        "Both images of each pair are degraded alike, with different noise: there is less change, "
        "but less to see."
    ),
}

Compared = tuple[FeatureResult, FeatureResult]
"""What one feature gives on the same pairs: degraded, and in daylight."""


def degraded_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    pairs: Sequence[PlanarPair],
    key: str,
    what: str,
    images: DegradedImages = "second",
) -> Part:
    """Measure all features on all pairs, in daylight and with each degradation.

    Args:
        context: data and cache; the copies are kept beside what is cached.
        features: what is compared.
        pairs: what it is measured on.
        key: beginning of the tables' keys.
        what: the data, for the tables' titles.
        images: which of a pair are degraded.
    """
    items = {(name, pair.name): pair for name in (DAYLIGHT, *DEGRADATIONS) for pair in pairs}

    def measure(feature: LocalFeature, item: tuple[str, PlanarPair]) -> PairResult:
        name, pair = item
        if name != DAYLIGHT:
            pair = degraded_pair(pair, DEGRADATIONS[name], context.files_folder(), images)
        return measure_pair(context, feature, pair, DEGRADED_BUDGETS)

    def summarize(found: Mapping[tuple[str, str], PairResult]) -> Shown:
        compared = {
            name: [_compared(found, feature, name, pairs) for feature in features]
            for name in DEGRADATIONS
        }
        return [
            overview_table(compared, key, what),
            *(degraded_table(compared[name], one, key, what) for name, one in DEGRADATIONS.items()),
        ]

    named = {_item_name(*names): (names[0], pair) for names, pair in items.items()}
    return feature_part(features, named, "", measure, summarize)


def _item_name(degradation: str, pair: str) -> str:
    return f"{pair}, {degradation}"


def _compared(
    found: Mapping[tuple[str, str], PairResult],
    feature: LocalFeature,
    degradation: str,
    pairs: Sequence[PlanarPair],
) -> Compared:
    """Return the results on the pairs that could be measured in both ways."""
    both = []
    for pair in pairs:
        names = [(feature.name, _item_name(one, pair.name)) for one in (degradation, DAYLIGHT)]
        if all(name in found for name in names):
            both.append([found[name] for name in names])
    degraded, daylight = (FeatureResult(feature, [one[k] for one in both]) for k in (0, 1))
    return degraded, daylight


def degraded_pair(
    pair: PlanarPair, degradation: Degradation, folder: Path, images: DegradedImages = "second"
) -> PlanarPair:
    """Return a pair whose second image, or both, are degraded copies in a folder."""
    second = degraded_copy(pair.second, degradation, folder)
    if images == "second":
        return replace(pair, second=second)
    return replace(pair, first=degraded_copy(pair.first, degradation, folder), second=second)


def degraded_copy(image: Path, degradation: Degradation, folder: Path) -> Path:
    """Return the PNG file of a degraded copy of an image; it is made where it is missing.

    Raises:
        DeepDetectError: it cannot be written.
    """
    digest = file_digest(image)[:16]
    path = folder / "degraded" / f"{digest}-{degradation.name}-v{degradation.version}.png"
    if not path.exists():
        copy = degrade(load_image(image), degradation)
        with atomic_path(path) as temporary:
            encoded = cv2.imencode(".png", cv2.cvtColor(copy, cv2.COLOR_RGB2BGR))[1]
            temporary.write_bytes(encoded.tobytes())
    return path


def _repeated(one: FeatureResult, budget: int, k: int) -> float | None:
    found = one.repeatability(budget, k)
    return None if found is None else found[0]


def _relative(value: Callable[[FeatureResult], float | None], both: Compared) -> Cell:
    degraded, daylight = (value(one) for one in both)
    return degraded / daylight if degraded is not None and daylight else None


def _values() -> list[tuple[str, int | None, str, Callable[[FeatureResult], float | None]]]:
    """Return name, budget, style and function of what is compared."""
    repeated = [
        (f"@{RADII_PX[k]:g} px", budget, ".3f", partial(_repeated, budget=budget, k=k))
        for k in (0, len(RADII_PX) - 1)
        for budget in DEGRADED_BUDGETS
    ]
    return [*repeated, ("correct at 1 px", MATCHING_BUDGET, ",.0f", FeatureResult.correct)]


def _accuracy(one: FeatureResult) -> float | None:
    return one.mean(lambda pair: float(accuracy_at(pair.corner_errors_px, HOMOGRAPHY_THRESHOLD_PX)))


def overview_table(compared: Mapping[str, Sequence[Compared]], key: str, what: str) -> Table:
    """Tabulate what is left of the daylight's score, at one budget and for all degradations."""
    values = [value for value in _values() if value[1] == MATCHING_BUDGET]
    columns = [
        Column(f"{DEGRADATIONS[name].title}: {title}", ".0%")
        for name in compared
        for title, *_ in values
    ]
    rows: list[tuple[Cell, ...]] = []
    for of_feature in zip(*compared.values(), strict=True):
        cells = [_relative(value, both) for both in of_feature for *_, value in values]
        rows.append((of_feature[0][0].feature.title, *cells))
    note = (
        f"Score over that of the same pairs in daylight, at {MATCHING_BUDGET:,} keypoints: "
        "mutual-NN repeatability, and correct matches at 1 px. A dash where a method does not fill "
        "the budget."
    )
    title = f"Dark and blurred: fraction of the score in daylight, {what}"
    return Table(f"{key}_relative", title, (Column("method"), *columns), tuple(rows), note)


def degraded_table(
    compared: Sequence[Compared], degradation: Degradation, key: str, what: str
) -> Table:
    """Tabulate the scores with a degradation, each with its fraction of that in daylight."""
    daylight = {both[0].feature.name: both for both in compared}

    def relative(one: FeatureResult, value: Callable[[FeatureResult], float | None]) -> Cell:
        return _relative(value, daylight[one.feature.name])

    columns: Columns = [
        *(
            column
            for title, budget, style, value in _values()
            for column in (
                (Column(f"{title}, {budget_name(budget)}", style), value),
                (
                    Column(f"{title}, {budget_name(budget)}: of daylight", ".0%"),
                    partial(relative, value=value),
                ),
            )
        ),
        (Column(f"homography at {HOMOGRAPHY_THRESHOLD_PX:g} px", ".3f"), _accuracy),
        (
            Column(f"keypoints, of at most {DEGRADED_BUDGETS[-1]:,}", ",.0f"),
            lambda one: one.mean(lambda pair: pair.counts[DEGRADED_BUDGETS[-1]]),
        ),
    ]
    note = (
        "Mutual-NN repeatability and correct matches as in the standard protocol; of daylight: "
        "over the score of the same pairs in daylight. A budget that a method does not fill is a "
        "dash. Keypoints: in the image that has fewer."
    )
    title = f"{degradation.title}, {what}"
    results = [degraded for degraded, _ in compared]
    return tabulate(results, f"{key}_{degradation.name}", title, columns, note)
