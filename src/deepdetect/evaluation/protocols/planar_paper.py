"""The paper's measures on scenes with homographies: density, repeatability, correct matches."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...datasets.types import PlanarPair, PlanarScene
from ...geometry.residuals import transfer_errors
from ..baselines import Method
from ..metrics import published_repeatability
from ..report import Cell, Column, Table
from ..stages import MatchSettings
from ..weights_quality import CORRECT
from ..workspace import Workspace, matrix_key

PAPER_MATCHING = MatchSettings(matcher="flann", ratio=0.99)


def density_table(
    workspace: Workspace, methods: Sequence[Method], scenes: Sequence[PlanarScene], key: str
) -> Table:
    """Tabulate the keypoints a pixel, mean over the images of each scene and over all images."""
    rows: list[tuple[Cell, ...]] = []
    for method in methods:
        by_scene: list[list[float]] = []
        for scene in scenes:
            found = [
                workspace.attempt(
                    f"density of {method.title} on {image.parent.name}/{image.name}",
                    _density,
                    workspace,
                    method,
                    image,
                )
                for image in scene.images
            ]
            by_scene.append([value for value in found if value is not None])
            workspace.done(1, f"{method.name}, {scene.name}")
        every = [value for values in by_scene for value in values]
        rows.append((method.title, _mean(every), *map(_mean, by_scene)))
    columns = (Column("method"), Column("mean", ".4f"), *_scene_columns(scenes, ".4f"))
    note = "The mean is over all images. Several keypoints on one pixel all count."
    return Table(key, "Keypoints a pixel", columns, tuple(rows), note)


def repeatability_table(
    workspace: Workspace, methods: Sequence[Method], scenes: Sequence[PlanarScene], key: str
) -> Table:
    """Tabulate the published repeatability at 1 px: clipped, mean over the pairs of each scene."""
    rows: list[tuple[Cell, ...]] = []
    for method in methods:
        values = []
        for scene in scenes:
            found = [
                workspace.attempt(
                    f"repeatability of {method.title} on {pair.name}",
                    _repeatability,
                    workspace,
                    method,
                    pair,
                )
                for pair in scene.pairs()
            ]
            values.append(_mean([value for value in found if value is not None]))
            workspace.done(1, f"{method.name}, {scene.name}")
        rows.append((method.title, _mean([v for v in values if v is not None]), *values))
    columns = (Column("method"), Column("mean", ".4f"), *_scene_columns(scenes, ".4f"))
    note = (
        "Points of the first image that land under 1 px from some point of the second, over the "
        "smaller of the two counts, clipped at 1. It grows with the density: the controls say "
        "what it is worth."
    )
    return Table(key, "Repeatability as published", columns, tuple(rows), note)


def matches_table(
    workspace: Workspace, methods: Sequence[Method], pairs: Sequence[PlanarPair], key: str
) -> Table:
    """Tabulate the correct matches of each pair: FLANN, ratio 0.99, strictly under 1 px."""
    rows: list[tuple[Cell, ...]] = []
    for method in methods:
        cells: list[Cell] = []
        for pair in pairs:
            found = workspace.attempt(
                f"matches of {method.title} on {pair.name}",
                correct_matches,
                workspace,
                method,
                pair,
            )
            cells += [None, None] if found is None else [found[0], _share(*found)]
            workspace.done(1, f"{method.name}, {pair.name}")
        rows.append((method.title, *cells))
    columns = [Column("method")]
    for pair in pairs:
        columns += [Column(pair.name, ",d"), Column(f"{pair.name}, precision", ".2%")]
    note = (
        "FLANN (5 trees, 50 checks), ratio 0.99; correct: strictly under 1 px by the homography "
        "in the file. Binary descriptors (ORB, BRISK) are matched exactly by Hamming's distance. "
        "The number grows with the number of points, whatever they are: see the controls."
    )
    return Table(key, "Correct matches", tuple(columns), tuple(rows), note)


def correct_matches(workspace: Workspace, method: Method, pair: PlanarPair) -> tuple[int, int]:
    """Return the number of correct matches of a pair, and of all."""
    found = workspace.matches(method, pair, PAPER_MATCHING)
    errors = transfer_errors(found.points0, found.points1, pair.homography)
    return int(np.count_nonzero(errors < CORRECT)), len(found)


def steps(
    methods: Sequence[Method], scenes: Sequence[PlanarScene], pairs: Sequence[PlanarPair]
) -> int:
    """Return how many steps all three tables report."""
    return len(methods) * (2 * len(scenes) + len(pairs))


def _density(workspace: Workspace, method: Method, image: Path) -> float:
    return workspace.keypoints(method, image).features.density


def _repeatability(workspace: Workspace, method: Method, pair: PlanarPair) -> float:
    def make() -> dict[str, np.ndarray]:
        points = [
            workspace.keypoints(method, image).features.xy for image in (pair.first, pair.second)
        ]
        return {"value": np.array(published_repeatability(*points, pair.homography))}

    images = (pair.first, pair.second)
    depends = {"homography": matrix_key(pair.homography)}
    found = workspace.metric("published repeatability 1", method, images, depends, make)
    return float(found["value"])


def _scene_columns(scenes: Sequence[PlanarScene], style: str) -> tuple[Column, ...]:
    return tuple(Column(scene.name, style) for scene in scenes)


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None
