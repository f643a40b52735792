"""The Oxford scenes: Tables I and II, Figures 1, 2, 4, 5 and 6; and the field's measures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ...datasets.oxford import find_scene, load_oxford
from ...datasets.types import PlanarPair, PlanarScene
from ..charts import bar_chart
from ..options import BenchmarkOptions
from ..report import Cell, Figure, Section, Table
from ..weights_quality import PAIRS
from ..workspace import Workspace
from . import paper_figures, planar_paper
from .guided import guided_section, guided_steps
from .paper_numbers import DENSITY, MATCHES, NOTEBOOK_MATCHES, REPEATABILITY, SIX_SCENES
from .planar_sections import standard_sections, standard_steps

PAPER = "DeepDetect, in the paper"
PAPER_SIX = "DeepDetect, in the paper, graf, wall, bikes, leuven, trees, ubc"
PAIRS_OF_OXFORD = 40
GUIDED_PAIRS = (*PAIRS, ("boat", 6), ("bark", 6))


def oxford_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    """Return the number of steps that `oxford_sections` reports."""
    scenes = load_oxford(workspace.folder("oxford"))
    steps = 0
    if "paper" in options.protocols:
        density = options.density_methods()
        steps += planar_paper.steps(density, scenes, ())
        steps += planar_paper.steps(options.matching_methods(), (), PAIRS)  # type: ignore[arg-type]
    if "standard" in options.protocols:
        steps += 2 * standard_steps(options, scenes)
    if "guided" in options.protocols:
        steps += guided_steps(options, chosen_pairs(scenes, GUIDED_PAIRS))
    return steps


def oxford_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    """Measure the methods on the eight scenes."""
    folder = workspace.folder("oxford")
    scenes = load_oxford(folder)
    sections = []
    if "paper" in options.protocols:
        sections.append(_paper_section(workspace, options, scenes))
    if "standard" in options.protocols:
        for truth in ("published", "refined"):
            missing = _without_refined(folder) if truth == "refined" else []
            if len(missing) == PAIRS_OF_OXFORD:
                workspace.left_out.append(
                    "Oxford judged by refined homographies: there are no files H1toKp.refined; "
                    "`deepdetect benchmark refine-oxford` makes them"
                )
                continue
            judged = load_oxford(folder, truth)
            sections += standard_sections(
                workspace,
                options,
                judged,
                f"oxford_{truth}",
                f"Oxford, {truth} homographies",
                TRUTHS[truth],
            )
            if missing:
                workspace.left_out.append(
                    f"refined homographies of {', '.join(missing)}: there is no file H1toKp.refined"
                    "; these pairs are judged by the published one in that section too"
                )
    if "guided" in options.protocols:
        truths = {
            truth: chosen_pairs(load_oxford(folder, truth), GUIDED_PAIRS)
            for truth in ("refined", "published")
            if truth == "published" or len(_without_refined(folder)) < PAIRS_OF_OXFORD
        }
        sections.append(guided_section(workspace, options, truths, "oxford_guided", "Oxford"))
    return sections


TRUTHS = {
    "published": (
        "Judged by the homographies that the data set ships, for comparison with papers. They are "
        "wrong by up to 26 px in places, so figures at 1 px are limited by them."
    ),
    "refined": (
        "Judged by more accurate homographies, estimated anew from the images by "
        "`deepdetect benchmark refine-oxford` with no detector of ours in the loop."
    ),
}


def _without_refined(folder: Path) -> list[str]:
    return [
        f"{path.parent.name} 1-{path.name[4]}"
        for path in sorted(folder.glob("*/H1to?p"))
        if not path.with_name(f"{path.name}.refined").exists()
    ]


def chosen_pairs(
    scenes: Sequence[PlanarScene], chosen: Sequence[tuple[str, int]]
) -> list[PlanarPair]:
    """Return the pairs of scenes and numbers, as those of Table II."""
    return [list(find_scene(list(scenes), name).pairs())[number - 2] for name, number in chosen]


def _paper_section(
    workspace: Workspace, options: BenchmarkOptions, scenes: Sequence[PlanarScene]
) -> Section:
    methods = options.density_methods()
    pairs = chosen_pairs(scenes, PAIRS)
    density = planar_paper.density_table(workspace, methods, scenes, "oxford_density")
    repeatability = planar_paper.repeatability_table(
        workspace, methods, scenes, "oxford_repeatability"
    )
    matches = planar_paper.matches_table(
        workspace, options.matching_methods(), pairs, "oxford_matches"
    )
    blank: list[Cell] = [None] * len(scenes)
    counts: list[Cell] = []
    for pair in pairs:
        counts += [MATCHES.get(pair.name), None]
    tables = (
        _with_rows(density, [(PAPER, DENSITY, *blank)]),
        _with_rows(
            repeatability,
            [(PAPER, REPEATABILITY, *blank), (PAPER_SIX, SIX_SCENES, *blank)],
        ),
        _with_rows(matches, [(PAPER, *counts), *_notebook_rows(pairs)]),
    )
    return Section(
        "Oxford, the paper's protocol",
        (
            "Tables I, II and the Oxford half of III, Figures 1, 2, 4, 5 and 6. "
            "DeepDetect sees images squashed to "
            f"480x480 as {options.channels.upper()}; the classical detectors see them as they are. "
            "The paper's numbers stand in rows of their own, and so do those that its authors' "
            "public notebooks print; the paper's own of the classical detectors are not known to "
            "us, and are dashes.",
        ),
        tables,
        (
            _repeatability_figure(repeatability),
            *paper_figures.oxford_figures(workspace, options, scenes, pairs),
        ),
    )


def _notebook_rows(pairs: Sequence[PlanarPair]) -> list[tuple[Cell, ...]]:
    rows = []
    for title, known in NOTEBOOK_MATCHES.items():
        cells: list[Cell] = []
        for pair in pairs:
            found = known.get(pair.name)
            cells += [None, None] if found is None else [found[0], found[0] / found[1]]
        rows.append((f"{title}, in the authors' notebook", *cells))
    return rows


def _with_rows(table: Table, rows: Sequence[tuple[Cell, ...]]) -> Table:
    return Table(table.key, table.title, table.columns, (*table.rows, *rows), table.note)


def _repeatability_figure(table: Table) -> Figure:
    values = {str(row[0]): float(row[1]) for row in table.rows if isinstance(row[1], float)}
    ours = [name for name in values if name.startswith("DeepDetect")]
    png = bar_chart(values, "repeatability as published, mean of the scenes", ours)
    return Figure("oxford_repeatability", "Figure 1: average repeatability, with controls", png)
