"""HPatches: Table III and Figure 7, and the field's measures on 116 scenes and on the usual 108."""

from __future__ import annotations

from collections.abc import Sequence

from ...datasets.hpatches import in_d2net_subset, is_illumination, load_hpatches
from ...datasets.types import PlanarPair, PlanarScene
from ..options import BenchmarkOptions
from ..report import Cell, Column, Section, Table
from ..workspace import Workspace
from . import planar_paper
from .guided import guided_section, guided_steps
from .paper_figures import drawn_figures, match_figure
from .paper_numbers import MOST_MATCHES
from .planar_sections import standard_sections, standard_steps

DRAWN = 4  # scenes of Figure 7, half of each kind


def hpatches_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    """Return the number of steps that `hpatches_sections` reports."""
    scenes = load_hpatches(workspace.folder("hpatches"))
    steps = 0
    if "paper" in options.protocols:
        steps += planar_paper.steps(options.density_methods(), scenes, ())
        steps += len(options.matching_methods()) * len(scenes)
    if "standard" in options.protocols:
        steps += sum(standard_steps(options, chosen) for _, chosen in _sets(scenes))
    if "guided" in options.protocols:
        steps += guided_steps(options, _last_pairs(scenes))
    return steps


def hpatches_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    """Measure the methods on the scenes that are there."""
    scenes = load_hpatches(workspace.folder("hpatches"))
    sections = []
    if "paper" in options.protocols:
        sections.append(_paper_section(workspace, options, scenes))
    if "standard" in options.protocols:
        for name, chosen in _sets(scenes):
            key = f"hpatches_{len(chosen)}"
            sections += standard_sections(
                workspace, options, chosen, key, f"HPatches, {name}", "Judged by its own files."
            )
    if "guided" in options.protocols:
        truths = {"published": _last_pairs(scenes)}
        sections.append(guided_section(workspace, options, truths, "hpatches_guided", "HPatches"))
    return sections


def _last_pairs(scenes: Sequence[PlanarScene]) -> list[PlanarPair]:
    return [list(scene.pairs())[-1] for scene in scenes]


def _sets(scenes: Sequence[PlanarScene]) -> list[tuple[str, list[PlanarScene]]]:
    """Return all scenes, and those that papers usually take where they are fewer."""
    usual = [scene for scene in scenes if in_d2net_subset(scene)]
    sets = [(f"all {len(scenes)} scenes", list(scenes))]
    if 0 < len(usual) < len(scenes):
        sets.append((f"the usual {len(usual)} scenes", usual))
    return sets


def _paper_section(
    workspace: Workspace, options: BenchmarkOptions, scenes: Sequence[PlanarScene]
) -> Section:
    methods = options.density_methods()
    groups = {
        "illumination": [scene for scene in scenes if is_illumination(scene)],
        "viewpoint": [scene for scene in scenes if not is_illumination(scene)],
    }
    density = planar_paper.density_table(workspace, methods, scenes, "hpatches_density")
    by_scene = planar_paper.repeatability_table(
        workspace, methods, scenes, "hpatches_repeatability"
    )
    names = [scene.name for scene in scenes]
    rows: list[tuple[Cell, ...]] = []
    for row in by_scene.rows:
        values = dict(zip(names, row[2:], strict=True))
        cells: list[Cell] = [row[0]]
        for group in groups.values():
            known = [v for scene in group if isinstance(v := values[scene.name], float)]
            cells.append(sum(known) / len(known) if known else None)
        rows.append(tuple(cells))
    columns = (
        Column("method"),
        *(Column(f"{name}, {len(group)} scenes", ".4f") for name, group in groups.items()),
    )
    table = Table(
        "hpatches_table3",
        "Table III: repeatability as published, by kind of scene",
        columns,
        tuple(rows),
        by_scene.note,
    )
    last = _last_pairs(scenes)
    matches = planar_paper.matches_table(
        workspace, options.matching_methods(), last, "hpatches_matches"
    )
    drawn = [
        pair
        for kind in (True, False)
        for pair in [p for p, s in zip(last, scenes, strict=True) if is_illumination(s) is kind][
            : DRAWN // 2
        ]
    ]
    figures = drawn_figures(
        workspace, [(match_figure, options.own(), pair, "Figure 7") for pair in drawn]
    )
    return Section(
        "HPatches, the paper's protocol",
        (
            f"{len(scenes)} scenes, of 116 in the whole set. Matches of images 1 and 6. The paper "
            f"reports {MOST_MATCHES:,} as the most correct matches of a pair.",
        ),
        (table, by_scene, density, matches),
        figures,
    )
