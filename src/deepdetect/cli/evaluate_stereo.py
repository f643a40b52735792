"""`deepdetect evaluate-stereo`: true matches on stereo pairs."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from .shared import PATH, json_option, print_json


@click.command(
    "evaluate-stereo", short_help="True stereo matches of weights and of label settings."
)
@click.argument("scenes", type=PATH, nargs=-1, required=True)
@click.option(
    "--weights",
    multiple=True,
    metavar="NAME|FILE",
    help="default or dense, the bundled weights, or a file; may be repeated.",
)
@click.option(
    "--label-settings",
    "labels",
    multiple=True,
    metavar="NAME|FILE.toml",
    help="Label settings whose labels are the keypoints, without a network: paper or dense, "
    "or a file; may be repeated.",
)
@json_option
def evaluate_stereo(
    scenes: tuple[Path, ...], weights: tuple[str, ...], labels: tuple[str, ...], as_json: bool
) -> None:
    """Match the rectified stereo pairs SCENES, and judge the matches by their true disparity.

    A scene is a folder with left.png, right.png, disparity.png and calib.json. Matching knows
    neither the rows nor the truth; a match is right within 1 px. Random points at the same
    density and every pixel stand beside as controls.

    \b
    deepdetect evaluate-stereo cones/ teddy/ --weights default --weights dense
    deepdetect evaluate-stereo cones/ teddy/ --label-settings paper --label-settings mine.toml
    """
    from .._shared.progress import progress
    from ..datasets.middlebury import load_middlebury
    from ..detector.detector import DeepDetect
    from ..detector.pretrained import PRETRAINED
    from ..evaluation.stereo_quality import LabelKeypoints, stereo_quality
    from ..labels import LabelOptions, find_label_settings

    pairs = [load_middlebury(scene) for scene in scenes]
    sources = {}
    for name in labels:
        chosen = find_label_settings(name)
        options = LabelOptions(chosen.detectors, changes=chosen.changes)
        sources[f"labels {name}"] = LabelKeypoints(options)
    for name in weights if weights or labels else tuple(PRETRAINED):
        sources[f"weights {name}"] = DeepDetect(name)
    total = len(pairs) * (2 * len(sources) + 1)
    with progress(total, "matching", "pair", as_json) as bar:
        rows = stereo_quality(sources, pairs, bar.update)
    if as_json:
        print_json([{**asdict(row), "share": row.score.share} for row in rows])
        return
    width = max(len(row.source) for row in rows)
    click.echo(
        f"{'keypoints':<{width}}  {'pair':<12}{'density':>8}{'matches':>10}"
        f"{'right':>10}{'share':>7}"
    )
    for row in rows:
        click.echo(
            f"{row.source:<{width}}  {row.pair:<12}{row.density:>8.3f}{row.score.matches:>10,}"
            f"{row.score.right:>10,}{row.score.share:>7.3f}"
        )
