"""`deepdetect evaluate-stereo`: true matches on stereo pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from .._shared.errors import DeepDetectError
from ._options import PATH, json_option, print_json, report_failures

if TYPE_CHECKING:
    from ..evaluation.protocols.stereo_matches import StereoMatchScore


@click.command(
    "evaluate-stereo", short_help="True stereo matches of weights and of label settings."
)
@click.argument("scenes", type=PATH, nargs=-1, required=True)
@click.option(
    "--weights",
    multiple=True,
    metavar="NAME|FILE",
    help="default, dense or free, the pretrained weights, or a file; may be repeated.",
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
    """Match the rectified stereo pairs SCENES, and evaluate the matches by their true disparity.

    A scene is a folder with left.png, right.png, disparity.png and calib.json. Matching uses
    neither the rows nor the truth; a match is correct within 1 px. Random points of the same
    density and all pixels are the baselines. A scene that cannot be read does not stop the
    others: they are listed at the end, with exit code 1.

    \b
    deepdetect evaluate-stereo cones/ teddy/ --weights default --weights dense
    deepdetect evaluate-stereo cones/ teddy/ --label-settings paper --label-settings mine.toml
    """
    from ..datasets.middlebury import load_middlebury
    from ..detector.detector import DeepDetect, HeatmapDetector
    from ..detector.pretrained import PRETRAINED
    from ..evaluation.protocols.masks import LabelDetector
    from ..evaluation.protocols.stereo_matches import score_stereo_matches
    from ..labels import find_label_settings

    pairs, failures = [], []
    for scene in scenes:
        try:
            pairs.append(load_middlebury(scene))
        except DeepDetectError as error:
            failures.append(str(error))
    if not pairs:
        report_failures(failures, len(scenes), "scenes")
    sources: dict[str, HeatmapDetector] = {}
    for name in labels:
        sources[f"labels {name}"] = LabelDetector(find_label_settings(name))
    for name in weights if weights or labels else tuple(PRETRAINED):
        sources[f"weights {name}"] = DeepDetect(name)
    rows = score_stereo_matches(sources, pairs, quiet=as_json)
    if as_json:
        print_json([{**asdict(row), "precision": row.score.precision} for row in rows])
    else:
        _print_rows(rows)
    report_failures(failures, len(scenes), "scenes")


def _print_rows(rows: Sequence[StereoMatchScore]) -> None:
    width = max(len(row.source) for row in rows)
    click.echo(
        f"{'keypoints':<{width}}  {'pair':<12}{'density':>8}{'matches':>10}"
        f"{'correct':>10}{'precision':>11}"
    )
    for row in rows:
        click.echo(
            f"{row.source:<{width}}  {row.pair:<12}{row.density:>8.3f}{row.score.matches:>10,}"
            f"{row.score.correct:>10,}{row.score.precision:>11.3f}"
        )
