"""The dusty and the smoky pair (Figure 6): keypoints and matches where little can be seen."""

from __future__ import annotations

from ...datasets.low_visibility import load_low_visibility
from ..options import BenchmarkOptions
from ..report import Section
from ..workspace import Workspace
from . import planar_paper
from .guided import guided_section, guided_steps
from .paper_figures import drawn_figures, keypoint_figure, match_figure
from .planar_sections import standard_sections, standard_steps


def low_visibility_steps(workspace: Workspace, options: BenchmarkOptions) -> int:
    """Return the number of steps that `low_visibility_sections` reports."""
    scenes = load_low_visibility(workspace.folder("low-visibility"))
    steps = 0
    if "paper" in options.protocols:
        steps += planar_paper.steps(options.density_methods(), scenes, ())
        steps += len(options.matching_methods()) * len(scenes)
    if "standard" in options.protocols:
        steps += standard_steps(options, scenes)
    if "guided" in options.protocols:
        steps += guided_steps(options, [pair for scene in scenes for pair in scene.pairs()])
    return steps


def low_visibility_sections(workspace: Workspace, options: BenchmarkOptions) -> list[Section]:
    """Measure the methods on both pairs."""
    scenes = load_low_visibility(workspace.folder("low-visibility"))
    pairs = [pair for scene in scenes for pair in scene.pairs()]
    sections = []
    if "paper" in options.protocols:
        methods = options.density_methods()
        tables = (
            planar_paper.density_table(workspace, methods, scenes, "low_visibility_density"),
            planar_paper.repeatability_table(
                workspace, methods, scenes, "low_visibility_repeatability"
            ),
            planar_paper.matches_table(
                workspace, options.matching_methods(), pairs, "low_visibility_matches"
            ),
        )
        figures = drawn_figures(
            workspace,
            [
                *((keypoint_figure, options, scene) for scene in scenes),
                *((match_figure, options.own(), pair, "Figure 6") for pair in pairs),
            ],
        )
        text = "Nothing moves between the two images of a scene."
        title = "Low visibility, the paper's protocol"
        sections.append(Section(title, (text,), tables, figures))
    if "standard" in options.protocols:
        sections += standard_sections(
            workspace,
            options,
            scenes,
            "low_visibility",
            "Low visibility",
            "Nothing moves between the two images of a scene.",
        )
    if "guided" in options.protocols:
        truths = {"published": pairs}
        key = "low_visibility_guided"
        sections.append(guided_section(workspace, options, truths, key, "Low visibility"))
    return sections
