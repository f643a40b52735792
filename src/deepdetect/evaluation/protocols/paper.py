"""The paper's protocol on scenes with homographies: density, repeatability, correct matches."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from ...datasets.types import PlanarPair, PlanarScene
from ...features.keypoints import Keypoints
from ...geometry.residuals import transfer_errors
from ...io.image import load_image, luma
from ...labels import draw_label, fuse
from ...viz.draw import add_caption, draw_keypoints, draw_matches, hstack
from ..baselines.method import LocalFeature
from ..cache import matrix_digest
from ..charts import line_chart, picture
from ..context import BenchmarkContext, MatchSettings
from ..metrics.repeatability import repeatability_paper
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, Task

OXFORD_PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    ("boat", 2),
)
"""The pairs of the paper's Table II: scene, and number of the second image."""

CORRECT_PX = 1.0
"""A match is correct strictly under this distance."""

PAPER_MATCHING = MatchSettings(matcher="flann", ratio=0.99)

SEEDS = 3
"""FLANN's trees are random, and counts of one seed vary by some per cent."""

FEW_MATCHES = 1000
MANY_SEEDS = 64
"""Few correct matches (graf's are a hundred) vary by a tenth from seed to seed."""

Finish = Callable[[Table], Sequence[Table | Figure]]


def _as_it_is(table: Table) -> Sequence[Table | Figure]:
    return [table]


def density_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    scenes: Sequence[PlanarScene],
    key: str,
    finish: Finish = _as_it_is,
) -> Part:
    """Tabulate keypoints per pixel, mean over the images of each scene and over all images."""
    tasks = {
        (feature.name, image): Task(
            f"density of {feature.title} on {image.parent.name}/{image.name}",
            partial(_density, context, feature, image),
        )
        for feature in features
        for scene in scenes
        for image in scene.images
    }

    def summarize(found: Mapping[Any, float]) -> Sequence[Table | Figure]:
        rows: list[tuple[Cell, ...]] = []
        for feature in features:
            by_scene = [
                [found[feature.name, i] for i in scene.images if (feature.name, i) in found]
                for scene in scenes
            ]
            every = [value for values in by_scene for value in values]
            rows.append((feature.title, _mean(every), *map(_mean, by_scene)))
        columns = (Column("method"), Column("mean", ".4f"), *_scene_columns(scenes))
        note = "The mean is over all images. Several keypoints on one pixel all count."
        return finish(Table(key, "Keypoints per pixel", columns, tuple(rows), note))

    return Part(tasks, summarize)


def repeatability_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    scenes: Sequence[PlanarScene],
    key: str,
    finish: Finish = _as_it_is,
) -> Part:
    """Tabulate the paper's repeatability at 1 px: clipped, mean over the pairs of each scene."""
    tasks = {
        (feature.name, pair.name): Task(
            f"repeatability of {feature.title} on {pair.name}",
            partial(pair_repeatability, context, feature, pair),
        )
        for feature in features
        for scene in scenes
        for pair in scene.pairs()
    }

    def summarize(found: Mapping[Any, float]) -> Sequence[Table | Figure]:
        rows: list[tuple[Cell, ...]] = []
        for feature in features:
            names = [[(feature.name, pair.name) for pair in scene.pairs()] for scene in scenes]
            values = [_mean([found[n] for n in of_scene if n in found]) for of_scene in names]
            rows.append((feature.title, _mean([v for v in values if v is not None]), *values))
        columns = (Column("method"), Column("mean", ".4f"), *_scene_columns(scenes))
        note = (
            "Points of the first image that land under 1 px from some point of the second, over "
            "the smaller of the two counts, clipped at 1. It grows with the density: the baselines "
            "say what it is worth."
        )
        return finish(
            Table(key, "Repeatability as in the paper", columns, tuple(rows), note),
        )

    return Part(tasks, summarize)


def matches_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    pairs: Sequence[PlanarPair],
    key: str,
    title: str = "Correct matches",
    finish: Finish = _as_it_is,
) -> Part:
    """Tabulate the correct matches of each pair: FLANN, ratio 0.99, strictly under 1 px."""
    tasks = {
        (feature.name, pair.name): Task(
            f"matches of {feature.title} on {pair.name}",
            partial(correct_matches, context, feature, pair),
        )
        for feature in features
        for pair in pairs
    }

    def summarize(found: Mapping[Any, tuple[int, int]]) -> Sequence[Table | Figure]:
        rows: list[tuple[Cell, ...]] = []
        for feature in features:
            cells: list[Cell] = []
            for pair in pairs:
                correct, matches = found.get((feature.name, pair.name), (None, None))
                cells += [correct, correct / matches if correct is not None and matches else None]
            rows.append((feature.title, *cells))
        columns = [Column("method")]
        for pair in pairs:
            columns += [Column(pair.name, ",d"), Column(f"{pair.name}, precision", ".2%")]
        note = (
            "FLANN (5 trees, 50 checks), ratio 0.99; correct: strictly under 1 px by the "
            "homography in the file. Binary descriptors (ORB, BRISK) are matched exactly by "
            "Hamming's distance. The number grows with the number of points, whatever they are: "
            "see the baselines."
        )
        return finish(Table(key, title, tuple(columns), tuple(rows), note))

    return Part(tasks, summarize)


def _density(context: BenchmarkContext, feature: LocalFeature, image: Path) -> float:
    return context.keypoints(feature, image).features.density


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
        drawn = draw_keypoints(rgb, Keypoints(inside, found.scores, found.image_size))
        panels.append(add_caption(drawn, f"{feature.title}: {len(found):,}"))
        counts.append(f"{feature.title} {len(found):,}")
    title = f"Figure 2: keypoints of {scene.name}: {'; '.join(counts)}{note}"
    return Figure(f"keypoints_{scene.name}", title, picture(hstack(panels)))


def mask_figure(scene: PlanarScene) -> Figure:
    """Draw Figure 4: the keypoint and the edge mask of an image, and both combined."""
    rgb = load_image(scene.images[0])
    title = f"Figure 4: keypoint and edge masks, and both combined ({scene.name})"
    return Figure("masks", title, picture(draw_label(rgb, fuse(luma(rgb)))))


def loss_figure() -> Figure:
    """Draw Figure 5: the losses of the pretrained weights' last training run."""
    text = resources.files("deepdetect").joinpath("detector/weights/curves.csv").read_text("utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    epochs = [float(row["epoch"]) for row in rows]
    lines = {
        name.replace("_", " "): (epochs, [float(row[name]) for row in rows])
        for name in ("training_loss", "validation_loss")
    }
    title = (
        f"Figure 5: losses of the pretrained weights' last run, {len(rows)} validations; "
        f"the last {rows[-1]['validation_loss']}"
    )
    return Figure("losses", title, line_chart(lines, "epoch", "binary cross-entropy per pixel"))


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


def _scene_columns(scenes: Sequence[PlanarScene]) -> tuple[Column, ...]:
    return tuple(Column(scene.name, ".4f") for scene in scenes)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None
