"""Benchmarks on image pairs with known homographies: Oxford, HPatches, and low visibility."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from ...datasets.planar import (
    OXFORD_KINDS,
    PlanarPair,
    PlanarScene,
    load_hpatches,
    load_low_visibility,
    load_oxford,
)
from ..baselines.opencv import CLASSICAL, with_kd_trees
from ..options import BenchmarkOptions
from ..report import Figure, Rows, Section, Table, bar_chart
from ..run import Run
from . import paper
from .degraded import degraded_sections
from .guided import guided_sections
from .paper_numbers import (
    DEEPDETECT,
    FIGURE_6,
    HPATCHES_REPEATABILITY,
    MATCHES,
    NUMBERS,
    OXFORD_REPEATABILITY,
    with_paper_rows,
)
from .standard import standard_sections

KEYPOINT_SCENES = ("graf", "bikes", "leuven")
"""The paper's Figure 2 shows keypoints in these scenes of Oxford."""

GUIDED_PAIRS = (*paper.OXFORD_PAIRS, ("boat", 6), ("bark", 6))

FIGURE_7_SCENES = 4
"""Number of HPatches scenes in Figure 7: half with changing light, half with changing viewpoint."""

TRUTHS = {
    "published": (
        "Evaluated by the homographies that the data set publishes, for comparison with papers. "
        "In places they are wrong by up to 26 px, which limits all scores at 1 px."
    ),
    "refined": (
        "Evaluated by more accurate homographies, which `benchmarks/refine_oxford.py` estimates "
        "from the images without any of our detectors."
    ),
}

NOTHING_MOVES = "Nothing moves between the images of a scene: the true homography is the identity."


def oxford(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the chosen protocols on Oxford with published homographies, and refined ones if found."""
    folder = run.folder("oxford")
    by_truth = {"published": load_oxford(folder), "refined": load_oxford(folder, "refined")}
    for truth, of_truth in by_truth.items():
        by_truth[truth] = [scene.with_max_pairs(options.max_pairs) for scene in of_truth]
    scenes = by_truth["published"]
    if missing := [name for name in OXFORD_KINDS if name not in {scene.name for scene in scenes}]:
        run.skipped.append(f"Oxford's {', '.join(missing)}: there is no such scene in {folder}")
    pairs = pairs_of(scenes)
    unrefined = [
        pair.name
        for pair in pairs
        if not (pair.first.parent / f"H1to{pair.number}p.refined").exists()
    ]
    if len(unrefined) == len(pairs):
        unrefined = ["all pairs"]
        del by_truth["refined"]
    if unrefined and {*options.protocols} - {"paper"}:
        run.skipped.append(
            f"refined homographies of {', '.join(unrefined)}: there are no files H1toKp.refined "
            "(run benchmarks/refine_oxford.py); published homographies are used for these pairs"
        )
    sections = _oxford_paper(run, options, scenes)
    for truth, of_truth in by_truth.items():
        key, title = f"oxford_{truth}", f"Oxford, {truth} homographies"
        sections += standard_sections(run, options, pairs_of(of_truth), key, title, TRUTHS[truth])
    chosen = {t: select_pairs(by_truth[t], GUIDED_PAIRS) for t in reversed(by_truth)}
    sections += guided_sections(run, options, chosen, "oxford", "Oxford")
    # `of_truth` and `title` are those of the last ground truth, which is the most accurate one.
    return sections + degraded_sections(run, options, pairs_of(of_truth), "oxford", title)


def _oxford_paper(
    run: Run, options: BenchmarkOptions, scenes: Sequence[PlanarScene]
) -> list[Section]:
    if "paper" not in options.protocols:
        return []
    features, matching = options.density_features(), with_kd_trees(options.matching_features())
    pairs = select_pairs(scenes, paper.OXFORD_PAIRS)
    density = paper.density_table(run, features, scenes, "oxford_density", with_paper=True)
    repeatability = paper.repeatability_table(run, features, scenes, "oxford_repeatability")
    matches = paper.matches_table(run, matching, pairs, "oxford_matches")
    figure_6_pairs = select_pairs(scenes, (*paper.OXFORD_PAIRS, ("graf", 3)))
    drawn = [scene for scene in scenes if scene.name in KEYPOINT_SCENES]
    figure_6, figures = _figures(run, options, figure_6_pairs, "oxford", drawn)
    text = (
        "Tables I and II of the paper, the Oxford half of Table III, and Figures 1, 2, 4 and 6, "
        f"with the paper's numbers next to ours. DeepDetect gets {options.channels.upper()} images "
        "resized to 480x480; the classical detectors get the original images."
    )
    tables = [
        density,
        with_paper_rows(repeatability, OXFORD_REPEATABILITY),
        with_paper_rows(matches, MATCHES),
        figure_6,
    ]
    values = {row["method"]: row["mean"] for row in repeatability.rows if row["mean"] is not None}
    ours = [name for name in values if name.startswith("DeepDetect")]
    png = bar_chart(values, "repeatability as in the paper, mean of the scenes", ours)
    mean = OXFORD_REPEATABILITY[DEEPDETECT]["mean"]
    title = f"Figure 1: average repeatability, with baselines; in the paper DeepDetect has {mean}"
    figure_1 = Figure("oxford_repeatability", title, png)
    figure_4 = _drawn(run, "Figure 4, masks", paper.mask_figure, scenes[:1])
    figures = [figure_1, *figures, *figure_4]
    return [Section("Oxford, the paper's protocol", (text,), tables, figures)]


def _figures(
    run: Run,
    options: BenchmarkOptions,
    pairs: Sequence[PlanarPair],
    key: str,
    scenes: Sequence[PlanarScene],
) -> tuple[Table, list[Figure]]:
    features = CLASSICAL["sift"], CLASSICAL["sift-low"], options.deepdetect_480()
    table = paper.matches_table(run, features, pairs, f"{key}_figure6", "Figure 6: correct matches")
    keypoints = partial(paper.keypoint_figure, run, features)
    matches = partial(paper.match_figure, run, features[-1], "Figure 6")
    figures = [
        *_drawn(run, "Figure 2, keypoints", keypoints, scenes),
        *_drawn(run, "Figure 6, matches", matches, pairs),
    ]
    return with_paper_rows(table, FIGURE_6), figures


def _drawn(
    run: Run, what: str, draw: Callable[[Any], Figure], items: Sequence[PlanarPair | PlanarScene]
) -> list[Figure]:
    figures = [run.attempt(f"{what} of {item.name}", draw, item) for item in items]
    return [figure for figure in figures if figure is not None]


def hpatches(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the chosen protocols on HPatches, by the homographies that the data set publishes."""
    found = load_hpatches(run.folder("hpatches"))
    scenes = [scene.with_max_pairs(options.max_pairs) for scene in found]
    last = [scene.pairs[-1] for scene in scenes]
    sections = _hpatches_paper(run, options, scenes, last)
    what = f"hpatches_{len(scenes)}", f"HPatches, {len(scenes)} scenes"
    text = "Evaluated by the homographies that the data set publishes."
    sections += standard_sections(run, options, pairs_of(scenes), *what, text)
    sections += guided_sections(run, options, {"published": last}, "hpatches", "HPatches")
    return sections + degraded_sections(run, options, pairs_of(scenes), "hpatches", "HPatches")


def _hpatches_paper(
    run: Run, options: BenchmarkOptions, scenes: Sequence[PlanarScene], last: Sequence[PlanarPair]
) -> list[Section]:
    if "paper" not in options.protocols:
        return []
    features = options.density_features()
    repeatability = paper.repeatability_table(run, features, scenes, "hpatches_repeatability")
    light = {scene.name: scene.name.startswith("i_") for scene in scenes}
    of_kind = [[pair for pair in last if light[pair.scene] is kind] for kind in (True, False)]
    drawn = [pair for pairs in of_kind for pair in pairs[: FIGURE_7_SCENES // 2]]
    text = (
        f"Measured on {len(scenes)} of the 116 scenes of the data set. Matches are those between "
        "images 1 and 6 of each scene. The largest number of correct matches of a pair that the "
        f"paper reports is {NUMBERS['max_matches']:,}."
    )
    tables = [
        table_3(repeatability, light),
        repeatability,
        paper.density_table(run, features, scenes, "hpatches_density"),
        paper.matches_table(run, options.matching_features(), last, "hpatches_matches"),
    ]
    draw = partial(paper.match_figure, run, options.deepdetect_480(), "Figure 7")
    figures = _drawn(run, "Figure 7, matches", draw, drawn)
    return [Section("HPatches, the paper's protocol", (text,), tables, figures)]


def table_3(by_scene: Table, light: Mapping[str, bool]) -> Table:
    """Average the repeatability of scenes with changing light and of those with changing viewpoint.

    `by_scene` has a column for each scene. `light` maps a scene to True if its light changes.
    """
    titles = {}
    rows: Rows = [{"method": row["method"]} for row in by_scene.rows]
    for kind, wanted in (("illumination", True), ("viewpoint", False)):
        scenes = [name for name in light if light[name] is wanted]
        titles[kind] = f"{kind}, {len(scenes)} scenes"
        for cells, row in zip(rows, by_scene.rows, strict=True):
            known = [row[name] for name in scenes if row[name] is not None]
            cells[titles[kind]] = sum(known) / len(known) if known else None
    table = Table(
        "hpatches_table3",
        "Table III: repeatability as in the paper, by kind of scene",
        {"method": "", **dict.fromkeys(titles.values(), ".4f")},
        rows,
        f"{by_scene.note} The paper used 57 scenes with changing illumination and 59 with changing "
        "viewpoint.",
    )
    numbers = {
        title: {titles[kind]: value for kind, value in of_method.items()}
        for title, of_method in HPATCHES_REPEATABILITY.items()
    }
    return with_paper_rows(table, numbers)


def low_visibility(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the chosen protocols on the pairs in which dust or smoke hides the scene (Figure 6)."""
    scenes = load_low_visibility(run.folder("low-visibility"))
    pairs = pairs_of(scenes)
    key, title = "low_visibility", "Low visibility"
    sections = []
    if "paper" in options.protocols:
        features = options.density_features()
        figure_6, figures = _figures(run, options, pairs, key, scenes)
        tables = [
            paper.density_table(run, features, scenes, f"{key}_density"),
            paper.repeatability_table(run, features, scenes, f"{key}_repeatability"),
            paper.matches_table(run, options.matching_features(), pairs, f"{key}_matches"),
            figure_6,
        ]
        text = (NOTHING_MOVES,)
        sections.append(Section(f"{title}, the paper's protocol", text, tables, figures))
    sections += standard_sections(run, options, pairs, key, title, NOTHING_MOVES)
    return sections + guided_sections(run, options, {"published": pairs}, key, title)


def pairs_of(scenes: Sequence[PlanarScene]) -> list[PlanarPair]:
    """Return the pairs of all scenes."""
    return [pair for scene in scenes for pair in scene.pairs]


def select_pairs(
    scenes: Sequence[PlanarScene], chosen: Sequence[tuple[str, int]]
) -> list[PlanarPair]:
    """Return the chosen pairs, given as (scene, number of the second image), that exist."""
    found = {(pair.scene, pair.number): pair for pair in pairs_of(scenes)}
    return [found[name] for name in chosen if name in found]
