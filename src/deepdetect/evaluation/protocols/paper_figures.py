"""The paper's pictures, each with its numbers: Figures 2, 4, 5, 6 and 7."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from ...datasets.types import PlanarPair, PlanarScene
from ...detector.pretrained import pretrained_weights
from ...features.keypoints import Keypoints
from ...geometry.residuals import transfer_errors
from ...io.image import load_image, luma
from ...labels import draw_label, fuse
from ...viz.draw import add_caption, draw_keypoints, draw_matches, hstack
from ..baselines import CLASSICAL, Method
from ..charts import line_chart, picture
from ..options import BenchmarkOptions
from ..report import Figure
from ..workspace import Workspace
from .planar_paper import CORRECT, PAPER_MATCHING

KEYPOINT_SCENES = ("graf", "bikes", "leuven")


def oxford_figures(
    workspace: Workspace,
    options: BenchmarkOptions,
    scenes: Sequence[PlanarScene],
    pairs: Sequence[PlanarPair],
) -> list[Figure]:
    """Draw Figures 2, 4, 5 and 6."""
    shown = [scene for scene in scenes if scene.name in KEYPOINT_SCENES]
    tasks: list[tuple[Any, ...]] = [(keypoint_figure, options, scene) for scene in shown]
    tasks.append((mask_figure, scenes[0]))
    if options.detector.weights == pretrained_weights("default"):
        tasks.append((loss_figure,))
    else:
        workspace.left_out.append(
            "Figure 5, the losses: the package knows those of its own weights only"
        )
    tasks += [(match_figure, options.own(), pair, "Figure 6") for pair in pairs]
    return list(drawn_figures(workspace, tasks))


def drawn_figures(workspace: Workspace, tasks: Sequence[tuple[Any, ...]]) -> tuple[Figure, ...]:
    """Draw figures: functions of the workspace, with their other arguments.

    One that fails is left out and noted.
    """
    found = [
        workspace.attempt(f"a picture by {draw.__name__}", draw, workspace, *arguments)
        for draw, *arguments in tasks
    ]
    return tuple(figure for figure in found if figure is not None)


def mask_figure(workspace: Workspace, scene: PlanarScene) -> Figure:
    """Draw Figure 4: the keypoint and the edge mask of an image, and both combined."""
    rgb = load_image(scene.images[0])
    title = f"Figure 4: keypoint and edge masks, and both combined ({scene.name})"
    return Figure("masks", title, picture(draw_label(rgb, fuse(luma(rgb)))))


def keypoint_figure(workspace: Workspace, options: BenchmarkOptions, scene: PlanarScene) -> Figure:
    """Draw Figure 2: the keypoints of SIFT, of SIFT with low settings, and ours."""
    image = scene.images[0]
    rgb = load_image(image)
    panels, counts = [], []
    for method in (CLASSICAL["sift"], CLASSICAL["sift-low"], options.own()):
        found = workspace.keypoints(method, image).features
        inside = np.clip(np.rint(found.xy), 0, np.array(found.image_size) - 1)
        drawn = draw_keypoints(rgb, Keypoints(inside, found.scores, found.image_size))
        panels.append(add_caption(drawn, f"{method.title}: {len(found):,}"))
        counts.append(f"{method.title} {len(found):,}")
    title = f"Figure 2: keypoints of {scene.name}: {'; '.join(counts)}"
    return Figure(f"keypoints_{scene.name}", title, picture(hstack(panels)))


def loss_figure(workspace: Workspace) -> Figure:
    """Draw Figure 5: the losses of the bundled weights' last training run."""
    text = resources.files("deepdetect").joinpath("detector/weights/curves.csv").read_text("utf-8")
    rows = list(csv.DictReader(text.splitlines()))
    epochs = [float(row["epoch"]) for row in rows]
    lines = {
        name.replace("_", " "): (epochs, [float(row[name]) for row in rows])
        for name in ("training_loss", "validation_loss")
    }
    title = (
        f"Figure 5: losses of the bundled weights' last run, {len(rows)} validations; "
        f"the last {rows[-1]['validation_loss']}"
    )
    png = line_chart(lines, "epoch", "binary cross-entropy a pixel")
    return Figure("losses", title, png)


def match_figure(workspace: Workspace, method: Method, pair: PlanarPair, number: str) -> Figure:
    """Draw Figure 6 or 7: a sample of the matches of a pair, the correct ones green."""
    found = workspace.matches(method, pair, PAPER_MATCHING)
    correct = transfer_errors(found.points0, found.points1, pair.homography) < CORRECT
    drawn = draw_matches(
        load_image(pair.first), load_image(pair.second), found.points0, found.points1, correct
    )
    share = correct.mean() if len(correct) else 0.0
    title = (
        f"{number}: {method.title}, {pair.name}: {len(correct):,} matches, "
        f"{int(correct.sum()):,} correct ({share:.1%}); a random sample drawn"
    )
    key = f"matches_{pair.name.replace(' ', '_')}"
    return Figure(key, title, picture(drawn))
