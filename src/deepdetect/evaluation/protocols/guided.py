"""Unguided and guided matches side by side, each with its precision, and beside the controls.

Guided matching multiplies the matches of whatever points it is given, those that know nothing of
the image too: only beside them does a count tell something.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..._shared.options import replace_options
from ...datasets.types import PlanarPair
from ...geometry import transform_points
from ...geometry.residuals import transfer_errors
from ...io.image import load_image, luma
from ...matching.guided import guided_matches
from ...matching.guided.homography import nearest_keypoint
from ...matching.options import get_preset
from ...matching.pipeline import unguided_matches
from ..baselines import Method
from ..cache import file_digest
from ..metering import metered
from ..metrics.homography_accuracy import corner_error
from ..options import BenchmarkOptions
from ..report import Cell, Column, Section, Table
from ..stages import versions
from ..weights_quality import CORRECT
from ..workspace import Workspace
from .planar_paper import PAPER_MATCHING

SEEDS = 3


@dataclass(frozen=True, eq=False)
class FoundGuided:
    """The matches of a pair by one seed, as `match_images` gives them.

    Attributes:
        kind: what guided, as of `Guide`; with "none" the matches are unguided.
        matrix: the geometry, or None.
        points0, points1: (M, 2) matched positions.
        seconds, memory: of the guided matching alone, also where it found nothing: neither heat
            map and keypoints nor unguided matches are included.
    """

    kind: str
    matrix: np.ndarray | None
    points0: np.ndarray
    points1: np.ndarray
    seconds: float
    memory: int


def guided_steps(options: BenchmarkOptions, pairs: Sequence[PlanarPair]) -> int:
    """Return the number of steps that `guided_section` reports."""
    return len(_methods(options)) * len(pairs)


def guided_section(
    workspace: Workspace,
    options: BenchmarkOptions,
    truths: Mapping[str, Sequence[PlanarPair]],
    key: str,
    title: str,
) -> Section:
    """Match pairs unguided and guided.

    Args:
        workspace: data and cache.
        options: what is compared.
        truths: by name, the same pairs with the homographies that judge them.
        key: beginning of the tables' keys.
        title: of the section.
    """
    methods = _methods(options)
    rows: dict[str, list[tuple[Cell, ...]]] = {truth: [] for truth in truths}
    for pairs in zip(*truths.values(), strict=True):
        judged = dict(zip(truths, pairs, strict=True))
        for method in methods:
            what = f"guided matches of {method.title} on {pairs[0].name}"
            found = workspace.attempt(what, _measure, workspace, method, judged)
            for truth, cells in (found or {}).items():
                rows[truth].append((pairs[0].name, method.title, *cells))
            workspace.done(1, f"{method.name}, {pairs[0].name}, guided")
    tables = tuple(
        Table(
            f"{key}_{truth}".replace(" ", "_"),
            f"Unguided and guided matches, {truth} homographies",
            COLUMNS,
            tuple(rows[truth]),
            NOTE,
        )
        for truth in truths
    )
    text = (
        "Unguided: the paper's matching (SIFT of size 3, FLANN, ratio 0.99). Guided: "
        "`match_images`' own way: a geometry from few points of OpenCV's SIFT proposes, and a "
        "pair stays when both places look alike. The true homography only judges. DeepDetect sees "
        f"images squashed to 480x480 as {options.channels.upper()}."
    )
    return Section(f"{title}, unguided and guided", (text,), tables)


COLUMNS = (
    Column("pair"),
    Column("method"),
    Column("could be matched", ",d"),
    Column("unguided: correct", ",d"),
    Column("unguided: precision", ".2%"),
    Column("guided by"),
    Column("guided: correct", ",d"),
    Column("± of correct", ",.0f"),
    Column("guided: precision", ".2%"),
    Column("guided: of what could be", ".1%"),
    Column("least", ".1%"),
    Column("guided: one to one", ",d"),
    Column("guided: corners off, px", ".2f"),
    Column("guided: seconds", ".2f"),
)

NOTE = (
    f"Correct: strictly under {CORRECT:g} px by the true homography; each point of the first image "
    "counts once. Could be matched: points of the first image with any point of the second so near "
    "to their true place. One to one: correct matches, each point of the second image once. "
    f"Guided: the seed of the median count, the lower of two, of {SEEDS} seeds; ± is the counts' "
    "standard deviation, least the smallest of them as a share of what could be matched. A seed by "
    "which no geometry is trusted counts with the unguided matches that match_images gives then; "
    "the row tells how many seeds were guided where not all were. Corners: median over the seeds "
    "that a homography guided. Seconds: median of the guided matching alone, without heat map, "
    "keypoints and unguided matches; they may be those of an earlier run, from the cache. The "
    "controls' count is what the same geometry makes of points that know nothing of the image."
)


def _methods(options: BenchmarkOptions) -> tuple[Method, ...]:
    return (options.own(), *options.controls())


def _measure(
    workspace: Workspace, method: Method, judged: Mapping[str, PlanarPair]
) -> dict[str, tuple[Cell, ...]]:
    """Return the cells of a row by truth."""
    pair = next(iter(judged.values()))
    unguided = workspace.matches(method, pair, PAPER_MATCHING)
    guided = [find_guided(workspace, method, pair, seed) for seed in range(SEEDS)]
    second = load_image(pair.second).shape
    first = load_image(pair.first).shape
    cells: dict[str, tuple[Cell, ...]] = {}
    for truth, one in judged.items():
        places = transform_points(unguided.keypoints0, one.homography)
        gaps = nearest_keypoint(places, unguided.keypoints1, (second[1], second[0]))[1]
        could = int(np.count_nonzero(gaps < CORRECT))
        right = _right(unguided.points0, unguided.points1, one)
        cells[truth] = (
            could,
            int(right.sum()),
            float(right.mean()) if len(right) else None,
            *_guided_cells(guided, one, could, (first[1], first[0])),
        )
    return cells


def _guided_cells(
    guided: Sequence[FoundGuided], pair: PlanarPair, could: int, size: tuple[int, int]
) -> tuple[Cell, ...]:
    right = [_right(found.points0, found.points1, pair) for found in guided]
    counts = [int(one.sum()) for one in right]
    middle = int(np.argsort(counts, kind="stable")[(len(counts) - 1) // 2])
    once = np.unique(guided[middle].points1[right[middle]], axis=0)
    planes = [found.matrix for found in guided if found.kind == "homography"]
    corners = [corner_error(matrix, pair.homography, size) for matrix in planes]
    return (
        _guided_by([found.kind for found in guided]),
        counts[middle],
        float(np.std(counts, ddof=1)) if len(counts) > 1 else None,
        float(right[middle].mean()) if len(right[middle]) else None,
        counts[middle] / could if could else None,
        min(counts) / could if could else None,
        len(once),
        float(np.median(corners)) if corners else None,
        float(np.median([found.seconds for found in guided])),
    )


def _guided_by(kinds: Sequence[str]) -> str:
    """Tell what guided, and by how many of the seeds where not by all."""
    trusted = [kind for kind in kinds if kind != "none"]
    if not trusted:
        return "none"
    names = " or ".join(dict.fromkeys(trusted))
    if len(trusted) == len(kinds):
        return names
    return f"{names}, {len(trusted)} of {len(kinds)} seeds guided"


def _right(points0: np.ndarray, points1: np.ndarray, pair: PlanarPair) -> np.ndarray:
    return transfer_errors(points0, points1, pair.homography) < CORRECT


def find_guided(workspace: Workspace, method: Method, pair: PlanarPair, seed: int) -> FoundGuided:
    """Match a pair guided, unguided where no geometry is trusted, or read that from the cache.

    Args:
        workspace: with the cache.
        method: its keypoints lie on whole pixels.
        pair: its homography is not used.
        seed: of the guided matching.
    """
    images = (pair.first, pair.second)
    points = [workspace.keypoints(method, image).features.xy for image in images]

    def make() -> dict[str, np.ndarray]:
        grays = [luma(load_image(image)) for image in images]
        with metered() as meter:
            guide, found = guided_matches(*grays, *points, seed=seed)
        if found is None:
            options = replace_options(get_preset("default"), seed=seed)
            found = unguided_matches(grays, points, options)
        return {
            "kind": np.array(guide.model),
            "matrix": np.empty((0, 3)) if guide.matrix is None else guide.matrix,
            "rows0": found.rows0.astype(np.int32),
            "rows1": found.rows1.astype(np.int32),
            "meter": np.array([meter.seconds, meter.memory], np.float64),
        }

    key = {
        "method": method.name,
        "version": method.version,
        "images": [file_digest(image) for image in images],
        "seed": seed,
        **versions(),
    }
    found = workspace.cache.get("guided", key, make)
    seconds, memory = found["meter"].tolist()
    return FoundGuided(
        str(found["kind"]),
        found["matrix"] if len(found["matrix"]) else None,
        points[0][found["rows0"]],
        points[1][found["rows1"]],
        seconds,
        int(memory),
    )
