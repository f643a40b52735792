"""The section of the standard protocol for any scenes with homographies."""

from __future__ import annotations

from collections.abc import Sequence

from ...datasets.types import PlanarScene
from ..options import BenchmarkOptions
from ..report import Section
from ..workspace import Workspace
from . import standard_tables
from .standard_measures import measure


def standard_steps(options: BenchmarkOptions, scenes: Sequence[PlanarScene]) -> int:
    """Return the number of steps that `standard_sections` reports."""
    return len(options.standard_methods()) * sum(len(list(scene.pairs())) for scene in scenes)


def standard_sections(
    workspace: Workspace,
    options: BenchmarkOptions,
    scenes: Sequence[PlanarScene],
    key: str,
    title: str,
    text: str,
) -> list[Section]:
    """Measure all methods on all pairs.

    Args:
        workspace: data and cache.
        options: what is compared.
        scenes: whose pairs are measured.
        key: beginning of the tables' keys.
        title: of the section.
        text: what the truth is.
    """
    pairs = [pair for scene in scenes for pair in scene.pairs()]
    results = [measure(workspace, method, pairs) for method in options.standard_methods()]
    what = f"{title} ({len(pairs)} pairs)"
    tables = (
        *standard_tables.repeatability_tables(results, key, what),
        standard_tables.matching_table(results, key, what),
        standard_tables.homography_table(results, key, what),
        standard_tables.accuracy_table(results, key, what),
        standard_tables.cost_table(results, key),
    )
    figures = (standard_tables.accuracy_figure(results, key, what),)
    return [Section(f"{title}, the standard protocol", (text,), tables, figures)]
