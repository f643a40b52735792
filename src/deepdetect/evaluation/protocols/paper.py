"""The paper's protocol on scenes with homographies: density, repeatability, correct matches."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from ...datasets.types import PlanarPair, PlanarScene
from ...features.display import draw_matches
from ...features.keypoints import Keypoints
from ...geometry.residuals import transfer_errors
from ...io.image import load_image, luma
from ...labels import draw_label, fuse
from ...viz.draw import add_caption, hstack
from ..baselines.method import LocalFeature
from ..cache import matrix_digest
from ..charts import picture
from ..context import BenchmarkContext, MatchSettings
from ..metrics.repeatability import repeatability_paper
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, Shown, feature_part
from .paper_numbers import (
    MATCHES_CAUSES,
    NOT_IN_DENSITY,
    Paper,
    with_paper_column,
    with_paper_rows,
)

OXFORD_PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    ("boat", 2),
)
"""The pairs of the paper's Table II: scene, and number of the second image."""

CORRECT_PX = 1.0
"""A match is correct strictly under this distance."""

PAPER_MEAN = f"mean without {NOT_IN_DENSITY}"

PAPER_MATCHING = MatchSettings(matcher="flann", ratio=0.99)

SEEDS = 3
"""FLANN's trees are random, and counts of one seed vary by some per cent."""

FEW_MATCHES = 1000
MANY_SEEDS = 64
"""Few correct matches (graf's are a hundred) vary by a tenth from seed to seed."""

Finish = Callable[[Table], Shown]


def density_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    scenes: Sequence[PlanarScene],
    key: str,
    paper: Mapping[str, float] = {},
) -> Part:
    """Tabulate keypoints per pixel, mean over all images and those of each scene.

    The paper's numbers are beside the mean that they are of, without one of the scenes.
    """
    images = {f"{scene.name}/{path.name}": path for scene in scenes for path in scene.images}

    def summarize(found: Mapping[tuple[str, str], float]) -> Shown:
        def mean(feature: LocalFeature, chosen: Sequence[PlanarScene]) -> float | None:
            keys = [
                (feature.name, f"{one.name}/{path.name}") for one in chosen for path in one.images
            ]
            return _mean([found[each] for each in keys if each in found])

        columns = {"mean": scenes, **{scene.name: [scene] for scene in scenes}}
        note = "The mean is over all images. Several keypoints on one pixel all count."
        if paper:
            others = [scene for scene in scenes if scene.name != NOT_IN_DENSITY]
            columns = {"mean": scenes, PAPER_MEAN: others, **columns}
            note += (
                f" The paper's means are those without {NOT_IN_DENSITY}: of the classical "
                "detectors they are the same to all its digits, at both settings."
            )
        rows = [(f.title, *(mean(f, chosen) for chosen in columns.values())) for f in features]
        table = Table(key, "Keypoints per pixel", _columns(columns), tuple(rows), note)
        return [with_paper_column(table, PAPER_MEAN, paper) if paper else table]

    def measure(feature: LocalFeature, image: Path) -> float:
        return context.keypoints(feature, image).features.density

    return feature_part(features, images, "density of ", measure, summarize)


def repeatability_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    scenes: Sequence[PlanarScene],
    key: str,
    finish: Finish = lambda table: [table],
) -> Part:
    """Tabulate the paper's repeatability at 1 px: clipped, mean over the pairs of each scene."""
    pairs = {pair.name: pair for scene in scenes for pair in scene.pairs()}

    def summarize(found: Mapping[tuple[str, str], float]) -> Shown:
        rows: list[tuple[Cell, ...]] = []
        for feature in features:
            names = [[(feature.name, pair.name) for pair in scene.pairs()] for scene in scenes]
            values = [_mean([found[n] for n in of_scene if n in found]) for of_scene in names]
            rows.append((feature.title, _mean([v for v in values if v is not None]), *values))
        columns = _columns(["mean", *(scene.name for scene in scenes)])
        note = (
            "Points of the first image that land under 1 px from some point of the second, over "
            "the smaller of the two counts, clipped at 1. It grows with the density: the baselines "
            "say what it is worth."
        )
        return finish(Table(key, "Repeatability as in the paper", columns, tuple(rows), note))

    measure = partial(pair_repeatability, context)
    return feature_part(features, pairs, "repeatability of ", measure, summarize)


def matches_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    pairs: Sequence[PlanarPair],
    key: str,
    title: str = "Correct matches",
    paper: Mapping[str, Paper] = {},
    notebooks: Mapping[str, Mapping[str, tuple[int, int]]] = {},
) -> Part:
    """Tabulate correct matches under 1 px, and their fraction of all matches."""
    columns = [Column("method")]
    for pair in pairs:
        columns += [Column(pair.name, ",d"), Column(f"{pair.name}, precision", ".2%")]
    note = (
        "FLANN (5 trees, 50 checks), ratio 0.99; correct: strictly under 1 px by the "
        "homography in the file. Binary descriptors (ORB, BRISK) are matched exactly by "
        "Hamming's distance. The number grows with the number of points, whatever they are: "
        "see the baselines."
    )

    def row(title: str, counts: Mapping[str, tuple[int, int]]) -> tuple[Cell, ...]:
        cells: list[Cell] = [title]
        for pair in pairs:
            correct, matches = counts.get(pair.name, (None, None))
            cells += [correct, correct / matches if correct is not None and matches else None]
        return tuple(cells)

    def summarize(found: Mapping[tuple[str, str], tuple[int, int]]) -> Shown:
        ours = tuple(
            row(each.title, {name: counts for (f, name), counts in found.items() if f == each.name})
            for each in features
        )
        table = with_paper_rows(
            Table(key, title, tuple(columns), ours, note), paper, MATCHES_CAUSES
        )
        printed = (row(f"{name}, in the authors' notebook", n) for name, n in notebooks.items())
        return [replace(table, rows=(*table.rows, *printed))]

    measure = partial(correct_matches, context)
    named = {pair.name: pair for pair in pairs}
    return feature_part(features, named, "matches of ", measure, summarize)


def pair_repeatability(context: BenchmarkContext, feature: LocalFeature, pair: PlanarPair) -> float:
    """Return the paper's repeatability of a pair."""
    images = (pair.first, pair.second)

    def make() -> dict[str, np.ndarray]:
        first, second = (context.keypoints(feature, image).features.xy for image in images)
        return {"value": np.array(repeatability_paper(first, second, pair.homography))}

    depends = {"homography": matrix_digest(pair.homography)}
    return float(context.metric("repeatability_paper", feature, images, depends, make)["value"])


def correct_matches(
    context: BenchmarkContext, feature: LocalFeature, pair: PlanarPair, seed: int = 0
) -> tuple[int, int]:
    """Return the number of correct matches of a pair, and of all, by one seed of FLANN."""
    settings = MatchSettings(PAPER_MATCHING.matcher, PAPER_MATCHING.ratio, seed=seed)
    found = context.matches(feature, (pair.first, pair.second), settings)
    errors = transfer_errors(found.points0, found.points1, pair.homography)
    return int(np.count_nonzero(errors < CORRECT_PX)), len(found)


def mean_correct_matches(
    context: BenchmarkContext, feature: LocalFeature, pair: PlanarPair
) -> tuple[int, int]:
    """Return the same as means over `SEEDS` seeds, `MANY_SEEDS` under `FEW_MATCHES`, rounded."""
    counts: list[tuple[int, int]] = []
    for seed in range(MANY_SEEDS):
        if seed == SEEDS and np.mean(counts, axis=0)[0] >= FEW_MATCHES:
            break
        counts.append(correct_matches(context, feature, pair, seed))
    correct, matches = np.rint(np.mean(counts, axis=0)).astype(int).tolist()
    return correct, matches


def keypoint_figure(
    context: BenchmarkContext, features: Iterable[LocalFeature], scene: PlanarScene, note: str = ""
) -> Figure:
    """Draw Figure 2: the keypoints of SIFT, of SIFT with low settings, and ours."""
    image = scene.images[0]
    rgb = load_image(image)
    panels, counts = [], []
    for feature in features:
        found = context.keypoints(feature, image).features
        inside = np.clip(np.rint(found.xy), 0, np.array(found.image_size) - 1)
        drawn = Keypoints(inside, found.scores, found.image_size).draw(rgb)
        panels.append(add_caption(drawn, f"{feature.title}: {len(found):,}"))
        counts.append(f"{feature.title} {len(found):,}")
    title = f"Figure 2: keypoints of {scene.name}: {'; '.join(counts)}{note}"
    return Figure(f"keypoints_{scene.name}", title, picture(hstack(panels)))


def mask_figure(scene: PlanarScene) -> Figure:
    """Draw Figure 4: the keypoint and the edge mask of an image, and both combined."""
    rgb = load_image(scene.images[0])
    title = f"Figure 4: keypoint and edge masks, and both combined ({scene.name})"
    return Figure("masks", title, picture(draw_label(rgb, fuse(luma(rgb)))))


def match_figure(
    context: BenchmarkContext, feature: LocalFeature, pair: PlanarPair, number: str
) -> Figure:
    """Draw Figure 6 or 7: a sample of the matches of a pair, the correct ones green."""
    found = context.matches(feature, (pair.first, pair.second), PAPER_MATCHING)
    correct = transfer_errors(found.points0, found.points1, pair.homography) < CORRECT_PX
    drawn = draw_matches(
        load_image(pair.first), load_image(pair.second), found.points0, found.points1, correct
    )
    precision = correct.mean() if len(correct) else 0.0
    title = (
        f"{number}: {feature.title}, {pair.name}: {len(correct):,} matches, "
        f"{int(correct.sum()):,} correct ({precision:.1%}); a random sample drawn"
    )
    return Figure(f"matches_{pair.name.replace(' ', '_')}", title, picture(drawn))


def _columns(titles: Iterable[str]) -> tuple[Column, ...]:
    return (Column("method"), *(Column(title, ".4f") for title in titles))


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None
