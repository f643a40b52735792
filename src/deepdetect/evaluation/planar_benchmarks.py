"""The benchmarks of image pairs with homographies: Oxford, HPatches, dust and smoke."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal

from ..datasets.hpatches import in_d2net_subset, is_illumination, load_hpatches
from ..datasets.low_visibility import load_low_visibility
from ..datasets.oxford import SCENES, load_oxford
from ..datasets.types import PlanarPair, PlanarScene
from .baselines.method import LocalFeature
from .baselines.opencv import CLASSICAL, with_kd_trees
from .charts import bar_chart
from .context import BenchmarkContext
from .options import BenchmarkOptions
from .protocols.degraded import DEGRADED_TEXT, WHICH_TEXT, degraded_part
from .protocols.guided import guided_section
from .protocols.paper import (
    OXFORD_PAIRS,
    density_part,
    keypoint_figure,
    mask_figure,
    match_figure,
    matches_part,
    repeatability_part,
)
from .protocols.paper_numbers import (
    DEEPDETECT,
    DENSITY,
    FIGURE_2,
    FIGURE_6,
    HPATCHES_REPEATABILITY,
    MATCHES,
    MAX_MATCHES,
    NOTEBOOK_MATCHES,
    OXFORD_REPEATABILITY,
    with_paper_rows,
)
from .protocols.standard import standard_part
from .report import Cell, Column, Figure, Table
from .tasks import Part, SectionPlan, Shown, figure_part

Plans = list[SectionPlan]

KEYPOINT_SCENES = ("graf", "bikes", "leuven")
"""Of Figure 2."""

GUIDED_PAIRS = (*OXFORD_PAIRS, ("boat", 6), ("bark", 6))

FIGURE_7_SCENES = 4
"""Half of each kind."""

Truth = Literal["published", "refined"]

OXFORD_TRUTHS: dict[Truth, str] = {
    "published": (
        "Evaluated by the homographies that the data set ships, for comparison with papers. They "
        "are wrong by up to 26 px in places, so figures at 1 px are limited by them."
    ),
    "refined": (
        "Evaluated by more accurate homographies, estimated from the images by "
        "`benchmarks/refine_oxford.py` with no detector of ours in the loop."
    ),
}

NOTHING_MOVES = "Nothing moves between the two images of a scene."

FIGURE_2_TEXT = (
    "Figure 2 of the paper prints the keypoints of SIFT, SIFT with low settings and DeepDetect in "
    "two scenes that it does not name and that are not among these: "
    + "; ".join(f"{scene} scene {a:,}, {b:,}, {c:,}" for scene, (a, b, c) in FIGURE_2.items())
    + "."
)


def plan_oxford(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Tables I and II, the Oxford half of III, Figures 1, 2, 4 and 6; the other protocols."""
    folder = context.folder("oxford")
    max_pairs = options.pair_selection.max_pairs

    def load(truth: Truth) -> list[PlanarScene]:
        return [scene.with_max_pairs(max_pairs) for scene in load_oxford(folder, truth)]

    scenes = load("published")
    if missing := [name for name in SCENES if name not in {scene.name for scene in scenes}]:
        context.skipped.append(f"Oxford's {', '.join(missing)}: not in {folder}")
    names = [pair.name for scene in scenes for pair in scene.pairs()]
    unrefined = [
        name
        for path in sorted(folder.glob("*/H1to?p"))
        if (name := f"{path.parent.name} 1-{path.name[4]}") in names
        and not path.with_name(f"{path.name}.refined").exists()
    ]
    truths: list[Truth] = ["published"]
    if len(unrefined) < len(names):
        truths.append("refined")
    plans = []
    if "paper" in options.protocols:
        plans.append(_oxford_paper(context, options, scenes))
    if "standard" in options.protocols:
        for truth in truths:
            title, by_truth = f"Oxford, {truth} homographies", load(truth)
            text = OXFORD_TRUTHS[truth]
            plans.append(
                _standard_section(context, options, by_truth, f"oxford_{truth}", title, text)
            )
        if "refined" not in truths:
            context.skipped.append(
                "Oxford evaluated by refined homographies: there are no files H1toKp.refined; "
                "benchmarks/refine_oxford.py makes them"
            )
        elif unrefined:
            context.skipped.append(
                f"refined homographies of {', '.join(unrefined)}: there is no file H1toKp.refined"
                "; these pairs are evaluated by the published one in that section too"
            )
    if "guided" in options.protocols:
        pairs: dict[str, list[PlanarPair]] = {
            truth: select_pairs(load(truth), GUIDED_PAIRS) for truth in reversed(truths)
        }
        plans.append(guided_section(context, options, pairs, "oxford_guided", "Oxford"))
    if "degraded" in options.protocols:
        truth = truths[-1]
        by_truth, title = load(truth), f"Oxford, {truth} homographies"
        plans.append(_degraded_section(context, options, by_truth, "oxford_degraded", title))
    return plans


def _oxford_paper(
    context: BenchmarkContext, options: BenchmarkOptions, scenes: list[PlanarScene]
) -> SectionPlan:
    features = options.density_features()
    pairs = select_pairs(scenes, OXFORD_PAIRS)
    figure_6 = select_pairs(scenes, (*OXFORD_PAIRS, ("graf", 3)))

    def with_figure_1(table: Table) -> Shown:
        return [with_paper_rows(table, OXFORD_REPEATABILITY), _repeatability_figure(table)]

    parts = [
        density_part(context, features, scenes, "oxford_density", DENSITY),
        repeatability_part(context, features, scenes, "oxford_repeatability", with_figure_1),
        matches_part(
            context,
            with_kd_trees(options.matching_features()),
            pairs,
            "oxford_matches",
            paper=MATCHES,
            notebooks=NOTEBOOK_MATCHES,
        ),
        *_figures(context, options, figure_6, "oxford", KEYPOINT_SCENES, scenes),
        figure_part("Figure 4, the masks", partial(mask_figure, scenes[0])),
    ]
    text = (
        "Tables I, II and the Oxford half of III, Figures 1, 2, 4 and 6. DeepDetect sees images "
        f"squashed to 480x480 as {options.channels.upper()}; the classical detectors see them as "
        "they are. The paper's numbers are beside ours, and so are those that its authors' public "
        f"notebooks print. {FIGURE_2_TEXT}"
    )
    return SectionPlan("Oxford, the paper's protocol", (text,), parts)


def _repeatability_figure(table: Table) -> Figure:
    values = {str(row[0]): float(row[1]) for row in table.rows if isinstance(row[1], float)}
    ours = [name for name in values if name.startswith("DeepDetect")]
    png = bar_chart(values, "repeatability as in the paper, mean of the scenes", ours)
    mean = OXFORD_REPEATABILITY[DEEPDETECT]["mean"]
    title = f"Figure 1: average repeatability, with baselines; in the paper DeepDetect has {mean}"
    return Figure("oxford_repeatability", title, png)


def _figures(
    context: BenchmarkContext,
    options: BenchmarkOptions,
    pairs: Sequence[PlanarPair],
    key: str,
    drawn: Sequence[str],
    scenes: Sequence[PlanarScene],
) -> list[Part]:
    """Make Figure 6 with its table, and Figure 2 of the scenes with these names."""
    features = CLASSICAL["sift"], CLASSICAL["sift-low"], options.deepdetect_480()
    table = matches_part(
        context, features, pairs, f"{key}_figure6", "Figure 6: correct matches", FIGURE_6
    )
    keypoints = [
        figure_part(
            f"Figure 2, keypoints of {scene.name}",
            partial(keypoint_figure, context, features, scene),
        )
        for scene in scenes
        if scene.name in drawn
    ]
    return [table, *keypoints, *_match_figures(context, features[-1], pairs, "Figure 6")]


def _match_figures(
    context: BenchmarkContext, feature: LocalFeature, pairs: Sequence[PlanarPair], number: str
) -> list[Part]:
    return [
        figure_part(
            f"{number}, matches of {pair.name}",
            partial(match_figure, context, feature, pair, number),
        )
        for pair in pairs
    ]


def plan_hpatches(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Table III and Figure 7, and the other protocols on 116 scenes and on the D2-Net subset."""
    found = load_hpatches(context.folder("hpatches"))
    scenes = [scene.with_max_pairs(options.pair_selection.max_pairs) for scene in found]
    last = [list(scene.pairs())[-1] for scene in scenes]
    plans = []
    if "paper" in options.protocols:
        plans.append(_hpatches_paper(context, options, scenes, last))
    if "standard" in options.protocols:
        text = "Evaluated by its own files."
        for name, subset in hpatches_subsets(scenes):
            key, title = f"hpatches_{len(subset)}", f"HPatches, {name}"
            plans.append(_standard_section(context, options, subset, key, title, text))
    if "guided" in options.protocols:
        truths = {"published": last}
        plans.append(guided_section(context, options, truths, "hpatches_guided", "HPatches"))
    if "degraded" in options.protocols:
        plans.append(_degraded_section(context, options, scenes, "hpatches_degraded", "HPatches"))
    return plans


def hpatches_subsets(scenes: Sequence[PlanarScene]) -> list[tuple[str, list[PlanarScene]]]:
    """Return all scenes, and the D2-Net subset of them where it is smaller."""
    subset = [scene for scene in scenes if in_d2net_subset(scene)]
    subsets = [(f"all {len(scenes)} scenes", list(scenes))]
    if 0 < len(subset) < len(scenes):
        subsets.append((f"the {len(subset)} scenes of D2-Net", subset))
    return subsets


def _hpatches_paper(
    context: BenchmarkContext,
    options: BenchmarkOptions,
    scenes: Sequence[PlanarScene],
    last: Sequence[PlanarPair],
) -> SectionPlan:
    features = options.density_features()
    light = [is_illumination(scene) for scene in scenes]
    drawn = [
        pair
        for kind in (True, False)
        for pair in [pair for pair, one in zip(last, light, strict=True) if one is kind][
            : FIGURE_7_SCENES // 2
        ]
    ]
    parts = [
        repeatability_part(
            context,
            features,
            scenes,
            "hpatches_repeatability",
            lambda by_scene: [_table_3(by_scene, light), by_scene],
        ),
        density_part(context, features, scenes, "hpatches_density"),
        matches_part(context, options.matching_features(), last, "hpatches_matches"),
        *_match_figures(context, options.deepdetect_480(), drawn, "Figure 7"),
    ]
    text = (
        f"{len(scenes)} scenes, of 116 in the whole set. Matches of images 1 and 6. The paper "
        f"reports {MAX_MATCHES:,} as the most correct matches of a pair."
    )
    return SectionPlan("HPatches, the paper's protocol", (text,), parts)


def _table_3(by_scene: Table, light: Sequence[bool]) -> Table:
    """Average the repeatability by kind of scene; `light` says which change in illumination."""
    kinds = {"illumination": True, "viewpoint": False}
    titles = {kind: f"{kind}, {light.count(wanted)} scenes" for kind, wanted in kinds.items()}
    rows: list[tuple[Cell, ...]] = []
    for row in by_scene.rows:
        cells: list[Cell] = [row[0]]
        for wanted in kinds.values():
            values = [v for v, one in zip(row[2:], light, strict=True) if one is wanted]
            known = [value for value in values if isinstance(value, float)]
            cells.append(sum(known) / len(known) if known else None)
        rows.append(tuple(cells))
    table = Table(
        "hpatches_table3",
        "Table III: repeatability as in the paper, by kind of scene",
        (Column("method"), *(Column(title, ".4f") for title in titles.values())),
        tuple(rows),
        by_scene.note,
    )
    paper = {
        title: {titles[kind]: value for kind, value in numbers.items()}
        for title, numbers in HPATCHES_REPEATABILITY.items()
    }
    counts = " and ".join(str(light.count(wanted)) for wanted in kinds.values())
    cause = f"the paper's are of 57 and 59 scenes, ours of {counts}"
    return with_paper_rows(table, paper, {"": cause})


def plan_low_visibility(context: BenchmarkContext, options: BenchmarkOptions) -> Plans:
    """Run all protocols on the dusty and the smoky pair (Figure 6)."""
    scenes = load_low_visibility(context.folder("low-visibility"))
    pairs = [pair for scene in scenes for pair in scene.pairs()]
    key, title = "low_visibility", "Low visibility"
    plans = []
    if "paper" in options.protocols:
        features = options.density_features()
        names = [scene.name for scene in scenes]
        parts = [
            density_part(context, features, scenes, f"{key}_density"),
            repeatability_part(context, features, scenes, f"{key}_repeatability"),
            matches_part(context, options.matching_features(), pairs, f"{key}_matches"),
            *_figures(context, options, pairs, key, names, scenes),
        ]
        text = (NOTHING_MOVES, FIGURE_2_TEXT)
        plans.append(SectionPlan(f"{title}, the paper's protocol", text, parts))
    if "standard" in options.protocols:
        plans.append(_standard_section(context, options, scenes, key, title, NOTHING_MOVES))
    if "guided" in options.protocols:
        plans.append(guided_section(context, options, {"published": pairs}, f"{key}_guided", title))
    return plans


def _standard_section(
    context: BenchmarkContext,
    options: BenchmarkOptions,
    scenes: Sequence[PlanarScene],
    key: str,
    title: str,
    text: str,
) -> SectionPlan:
    pairs = [pair for scene in scenes for pair in scene.pairs()]
    what = f"{title} ({len(pairs)} pairs)"
    part = standard_part(context, options.standard_features(), pairs, key, what)
    return SectionPlan(f"{title}, the standard protocol", (text,), [part])


def _degraded_section(
    context: BenchmarkContext,
    options: BenchmarkOptions,
    scenes: Sequence[PlanarScene],
    key: str,
    title: str,
) -> SectionPlan:
    pairs = [pair for scene in scenes for pair in scene.pairs()]
    what = f"{title} ({len(pairs)} pairs)"
    images = options.degraded_images
    part = degraded_part(context, options.standard_features(), pairs, key, what, images)
    return SectionPlan(f"{title}, dark and blurred", (DEGRADED_TEXT, WHICH_TEXT[images]), [part])


def select_pairs(
    scenes: Sequence[PlanarScene], chosen: Sequence[tuple[str, int]]
) -> list[PlanarPair]:
    """Return the pairs of scenes and numbers, as those of Table II; those that are there."""
    there = {(pair.scene, pair.number): pair for scene in scenes for pair in scene.pairs()}
    return [there[key] for key in chosen if key in there]
