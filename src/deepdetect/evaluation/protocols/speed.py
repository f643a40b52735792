"""How long each stage takes, and how much memory: all methods in turn, several times."""

from __future__ import annotations

from ..._shared.errors import ImageError
from ...datasets.planar import PlanarPair, load_oxford
from ..baselines.method import LocalFeature
from ..options import BenchmarkOptions
from ..report import Cell, Columns, Row, Rows, Section, largest, tabulate
from ..run import Run
from .paper import PAPER_MATCHING
from .planar import select_pairs
from .standard import MEMORY_COLUMNS, SECONDS_COLUMNS, STAGES, stage_costs

PAIR = ("graf", 3)
ROUNDS = 3


def speed(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run all features on one pair in turn, so that a busy machine affects them equally.

    Nothing is read from the cache. The first round warms up and is not counted.
    """
    folder = run.folder("oxford")
    pairs = select_pairs(load_oxford(folder), [PAIR])
    if not pairs:
        raise ImageError(f"speed is measured on {PAIR[0]} of Oxford, which is not in {folder}")
    features = options.matching_features()
    rows: Rows = []
    for turn in range(ROUNDS + 1):
        found = run.rows("speed of ", features, {pairs[0].name: pairs[0]}, _measure)
        rows += found if turn else []

    def slowest(own: Rows) -> Cell:
        totals = [sum(row["seconds", stage] or 0 for stage in STAGES) for row in own]
        return max(totals) / min(totals) if totals else None

    columns: Columns = {
        "keypoints": largest(",d", "keypoints"),
        "matches": largest(",d", "matches"),
        **SECONDS_COLUMNS,
        "slowest over fastest round": (".2f", slowest),
        **MEMORY_COLUMNS,
    }
    note = (
        f"{pairs[0].name}, the paper's matching. Medians of {ROUNDS} rounds over all methods; "
        "detecting in the first image, describing both, matching the pair. Memory: the largest "
        "growth of the process during the stage."
    )
    table = tabulate("speed", "Seconds and memory of each stage", features, rows, columns, note)
    return [Section("Speed", (), [table])]


def _measure(feature: LocalFeature, pair: PlanarPair) -> Row:
    fresh = Run(pair.first.parent)
    keypoints, detected = fresh.keypoints(feature, pair.first)
    found = fresh.matches(feature, (pair.first, pair.second), PAPER_MATCHING)
    counts = {"keypoints": len(keypoints), "matches": len(found.points0)}
    return counts | stage_costs(feature, detected, found)
