"""How long each stage and a whole pair take, and how much memory: all in turn, several times."""

from __future__ import annotations

import numpy as np

from ...datasets.oxford import find_scene, load_oxford
from ..baselines import Method
from ..cache import StageCache
from ..options import BenchmarkOptions
from ..report import Cell, Column, Section, Table
from ..stages import FoundFeatures, FoundMatches, find_keypoints, find_matches
from ..workspace import Workspace
from .descriptor_speed import descriptor_steps, descriptor_table
from .planar_paper import PAPER_MATCHING
from .whole_pairs import whole_pair_steps, whole_pair_table

PAIR = ("graf", 3)
REPEATS = 3


def speed_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    """Return the number of steps that `speed_sections` reports."""
    load_oxford(workspace.folder("oxford"))
    rounds = (REPEATS + 1) * len(options.matching_methods())
    return rounds + descriptor_steps() + whole_pair_steps()


def speed_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    """Run all methods on one pair in turn, so that a busy machine hits them alike.

    Nothing is read from the cache. A first round warms up and is not counted.
    """
    scene = find_scene(load_oxford(workspace.folder("oxford")), PAIR[0])
    pair = list(scene.pairs())[PAIR[1] - 2]
    images = (pair.first, pair.second)
    methods = options.matching_methods()
    runs: dict[str, list[tuple[FoundFeatures, FoundMatches]]] = {m.name: [] for m in methods}
    for turn in range(REPEATS + 1):
        for method in methods:
            found = workspace.attempt(f"speed of {method.title}", _run, method, images)
            workspace.done(1, f"{method.name}, round {turn}")
            if turn and found is not None:
                runs[method.name].append(found)
    rows = tuple((method.title, *_row(method, runs[method.name])) for method in methods)
    stages = ("detect", "describe", "match")
    columns = (
        Column("method"),
        Column("keypoints", ",d"),
        Column("matches", ",d"),
        *(Column(f"{stage}, s", ".3f") for stage in stages),
        Column("slowest over fastest round", ".2f"),
        *(Column(f"{stage}, MB", ",.0f") for stage in stages),
    )
    note = (
        f"{pair.name}, the paper's matching. Medians of {REPEATS} rounds over all methods; "
        "detecting of the first image, describing of both, matching of the pair. Memory: the "
        "largest growth of the process during the stage."
    )
    table = Table("speed", "Seconds and memory of each stage", columns, rows, note)
    tables = (
        table,
        descriptor_table(workspace, pair.first),
        whole_pair_table(workspace, options),
    )
    return [Section("Speed", (), tables)]


def _run(method: Method, images: tuple) -> tuple[FoundFeatures, FoundMatches]:  # type: ignore[type-arg]
    nothing_kept = StageCache(None)
    keypoints = find_keypoints(nothing_kept, method, images[0])
    return keypoints, find_matches(nothing_kept, method, images, PAPER_MATCHING)


def _row(method: Method, runs: list[tuple[FoundFeatures, FoundMatches]]) -> tuple[Cell, ...]:
    if not runs:
        return (None,) * 9
    times = np.array([(k.seconds, m.describing.seconds, m.seconds) for k, m in runs])
    memory = np.array([(k.memory, m.describing.memory, m.memory) for k, m in runs])
    total = times.sum(1)
    medians: list[Cell] = [float(value) for value in np.median(times, axis=0)]
    if method.control:  # random points are counted by running the detector that they follow
        medians[0] = None
    keypoints, matches = runs[0]
    return (
        len(keypoints.features),
        len(matches),
        *medians,
        float(total.max() / total.min()),
        *(float(value) / 1e6 for value in memory.max(axis=0)),
    )
