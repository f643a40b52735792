"""How long each stage takes, and how much memory: all methods in turn, several times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from ...datasets.types import PlanarPair
from ..baselines.method import LocalFeature
from ..context import BenchmarkContext, ImageKeypoints, PairMatches
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, Task
from .paper import PAPER_MATCHING

PAIR = ("graf", 3)
ROUNDS = 3
STAGES = ("detect", "describe", "match")

Round = tuple[ImageKeypoints, PairMatches]


def speed_part(features: Sequence[LocalFeature], pair: PlanarPair) -> Part:
    """Run all features on one pair in turn, so that a busy machine affects them equally.

    Nothing is read from the cache. The first round warms up and is not counted.
    """
    tasks = {
        (turn, feature.name): Task(f"speed of {feature.title}", partial(_run, feature, pair))
        for turn in range(ROUNDS + 1)
        for feature in features
    }

    def summarize(found: Mapping[Any, Round]) -> Sequence[Table | Figure]:
        rows = []
        for feature in features:
            keys = [(turn, feature.name) for turn in range(1, ROUNDS + 1)]
            rows.append((feature.title, *_row(feature, [found[k] for k in keys if k in found])))
        columns = (
            Column("method"),
            Column("keypoints", ",d"),
            Column("matches", ",d"),
            *(Column(f"{stage}, s", ".3f") for stage in STAGES),
            Column("slowest over fastest round", ".2f"),
            *(Column(f"{stage}, MB", ",.0f") for stage in STAGES),
        )
        note = (
            f"{pair.name}, the paper's matching. Medians of {ROUNDS} rounds over all methods; "
            "detecting in the first image, describing both, matching the pair. Memory: the "
            "largest growth of the process during the stage."
        )
        return [Table("speed", "Seconds and memory of each stage", columns, tuple(rows), note)]

    return Part(tasks, summarize)


def _run(feature: LocalFeature, pair: PlanarPair) -> Round:
    nothing_kept = BenchmarkContext(pair.first.parent)
    images = (pair.first, pair.second)
    return (
        nothing_kept.keypoints(feature, pair.first),
        nothing_kept.matches(feature, images, PAPER_MATCHING),
    )


def _row(feature: LocalFeature, runs: Sequence[Round]) -> tuple[Cell, ...]:
    if not runs:
        return (None,) * 9
    profiles = [(k.profile, m.describe, m.match) for k, m in runs]
    times = np.array([[profile.seconds for profile in run] for run in profiles])
    memory = np.array([[profile.memory for profile in run] for run in profiles])
    total = times.sum(1)
    medians: list[Cell] = [float(value) for value in np.median(times, axis=0)]
    if feature.chance:  # random points are counted by running the detector that they follow
        medians[0] = None
    keypoints, matches = runs[0]
    return (
        len(keypoints.features),
        len(matches),
        *medians,
        float(total.max() / total.min()),
        *(float(value) / 1e6 for value in memory.max(axis=0)),
    )
