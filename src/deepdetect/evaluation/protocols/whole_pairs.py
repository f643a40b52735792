"""Whole pairs, from images to counted matches: the published pipeline beside ours, in turn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..._shared.errors import DeepDetectError
from ...datasets.middlebury import load_middlebury
from ...datasets.oxford import find_scene, load_oxford
from ...datasets.types import PlanarPair
from ...detector.detector import DeepDetect
from ...detector.heatmap import HeatmapOptions
from ...geometry import disparity_errors, transform_points
from ...io.image import load_image
from ...matching.pipeline import match_images
from ..metering import Meter, metered
from ..options import BenchmarkOptions
from ..report import Cell, Column, Table
from ..weights_quality import CORRECT
from ..workspace import Workspace
from .published_pipeline import RATIO, Judge, published_detector, published_pipeline

PLANAR = (("wall", 6), ("graf", 3))
STEREO = "cones"
ROUNDS = 5


@dataclass(frozen=True, eq=False)
class WholePair:
    """A pair and how its matches are judged.

    Attributes:
        name: of the pair.
        images: both, (H, W, 3) uint8 RGB.
        detector: with the weights for such pairs.
        one: judges a match at a time, as the published code does.
        every: judges all at once, (M, 2) and (M, 2) to (M,) bool.
    """

    name: str
    images: tuple[np.ndarray, np.ndarray]
    detector: DeepDetect
    one: Judge
    every: Callable[[np.ndarray, np.ndarray], np.ndarray]


def whole_pair_steps() -> int:
    """Return the number of steps that `whole_pair_table` reports."""
    return (len(PLANAR) + 1) * (ROUNDS + 1)


def whole_pair_table(workspace: Workspace, options: BenchmarkOptions) -> Table:
    """Run both sides on each pair in turn.

    Nothing is read from the cache. A first round compiles and is not counted.

    Args:
        workspace: data and progress.
        options: its weights are run by both sides, the stereo pair with those for geometry.
    """
    rows = []
    for name, make in _pairs(workspace, options):
        cells = workspace.attempt(f"the whole pair {name}", _row, workspace, name, make)
        rows.append((name, *(cells or (None,) * 10)))
    columns = (
        Column("pair"),
        Column("published, s", ".2f"),
        Column("ours, s", ".2f"),
        Column("times faster", ".1f"),
        Column("least", ".1f"),
        Column("most", ".1f"),
        Column("published: correct", ",d"),
        Column("ours: correct", ",d"),
        Column("published: MB", ",.0f"),
        Column("ours: MB", ",.0f"),
        Column("memory, ours over published", ".2f"),
    )
    note = (
        "From two images in memory to the count of right matches. Published: what the authors' "
        "notebook does (torch without compilation, lists of keypoints, OpenCV's SIFT, FLANN, loops "
        "in Python). Ours: the default backend, dense RootSIFT, patchmatch, unguided; both see the "
        f"same weights and images squashed to 480x480 as {options.channels.upper()}, and keep "
        f"ratios under {RATIO}. Right: under {CORRECT:g} px by the published homography or the "
        f"true disparity. Medians of {ROUNDS} rounds, both sides in turn; faster: median, least "
        "and most of the rounds' ratios. Memory: the largest growth of the process."
    )
    return Table(
        "whole_pairs", "Whole pairs: the published pipeline and ours", columns, tuple(rows), note
    )


def _row(workspace: Workspace, name: str, make: Callable[[], WholePair]) -> tuple[Cell, ...]:
    done = 0
    try:
        pair = make()
        published = published_detector(pair.detector)
        sides: dict[str, Callable[[], int]] = {
            "published": lambda: published_pipeline(pair.images, published, pair.one),
            "ours": lambda: _ours(pair),
        }
        meters: dict[str, list[Meter]] = {side: [] for side in sides}
        correct: dict[str, list[int]] = {side: [] for side in sides}
        for turn in range(ROUNDS + 1):
            for side, run in sides.items():
                with metered() as meter:
                    count = run()
                if turn:
                    meters[side].append(meter)
                    correct[side].append(count)
            workspace.done(1, f"{name}, round {turn}")
            done += 1
    finally:
        workspace.done(ROUNDS + 1 - done, name)
    seconds = {side: np.array([meter.seconds for meter in meters[side]]) for side in sides}
    memory = {side: max(meter.memory for meter in meters[side]) / 1e6 for side in sides}
    ratios = seconds["published"] / seconds["ours"]
    return (
        *(float(np.median(seconds[side])) for side in sides),
        float(np.median(ratios)),
        float(ratios.min()),
        float(ratios.max()),
        *(int(np.median(correct[side])) for side in sides),
        *(memory[side] for side in sides),
        memory["ours"] / memory["published"] if memory["published"] else None,
    )


def _ours(pair: WholePair) -> int:
    found = match_images(
        *pair.images,
        pair.detector,
        guided=False,
        matcher="patchmatch",
        descriptor="rootsift",
        ratio=RATIO,
        model="none",
    )
    return int(np.count_nonzero(pair.every(found.points0, found.points1)))


def _pairs(
    workspace: Workspace, options: BenchmarkOptions
) -> list[tuple[str, Callable[[], WholePair]]]:
    shown = HeatmapOptions(480, options.channels)
    scenes = load_oxford(workspace.folder("oxford"))
    chosen = [list(find_scene(scenes, name).pairs())[number - 2] for name, number in PLANAR]
    planar = [
        (pair.name, lambda pair=pair: _planar(pair, options.detector.configured(shown)))
        for pair in chosen
    ]
    stereo = (STEREO, lambda: _stereo(workspace, _geometry(options, shown)))
    return [*planar, stereo]


def _geometry(options: BenchmarkOptions, shown: HeatmapOptions) -> DeepDetect:
    return options.detector.with_weights(options.geometry_weights[0]).configured(shown)


def _planar(pair: PlanarPair, detector: DeepDetect) -> WholePair:
    matrix = pair.homography

    def one(x: float, y: float, u: float, v: float) -> bool:
        mapped = matrix @ np.array([x, y, 1.0])
        return bool(np.linalg.norm(mapped[:2] / mapped[2] - (u, v)) < CORRECT)

    def every(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.linalg.norm(transform_points(first, matrix) - second, axis=1) < CORRECT

    images = load_image(pair.first), load_image(pair.second)
    return WholePair(pair.name, images, detector, one, every)


def _stereo(workspace: Workspace, detector: DeepDetect) -> WholePair:
    folder = workspace.folder("middlebury") / STEREO
    if not folder.is_dir():
        raise DeepDetectError(f"there is no {folder}")
    pair = load_middlebury(folder)

    def one(x: float, y: float, u: float, v: float) -> bool:
        true = pair.disparity[round(y), round(x)]
        return bool(np.isfinite(true) and np.hypot(x - true - u, y - v) < CORRECT)

    def every(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return disparity_errors(first, second, pair.disparity) < CORRECT

    return WholePair(STEREO, (pair.left, pair.right), detector, one, every)
