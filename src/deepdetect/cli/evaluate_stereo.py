"""`deepdetect evaluate-stereo`: correct matches on stereo pairs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from .._shared.errors import DeepDetectError
from ..datasets.middlebury import load_middlebury
from ..detector.detector import DeepDetect, HeatmapDetector
from ..detector.pretrained import PRETRAINED
from ..evaluation.protocols.masks import LabelDetector
from ..evaluation.protocols.stereo_matches import score_stereo_matches
from ..labels import find_label_settings
from ._options import Json, print_json, report_failures


def evaluate_stereo(
    scenes: Annotated[
        list[Path],
        Parameter(help="Folders with left.png, right.png, disparity.png and calib.json."),
    ],
    /,
    *,
    weights: list[str] | None = None,
    label_settings: list[str] | None = None,
    as_json: Json = False,
) -> None:
    """Match rectified stereo pairs, and evaluate the matches by their true disparity.

    Matching uses neither the rows nor the truth; a match is correct within 1 px. Random points of
    the same density and all pixels are the baselines. A scene that cannot be read does not stop the
    others: they are listed at the end, with exit code 1.

        deepdetect evaluate-stereo cones/ teddy/ --weights default --weights dense
        deepdetect evaluate-stereo cones/ teddy/ --label-settings paper --label-settings mine.toml

    Args:
        weights: default, dense or free, the pretrained weights, or a file; may be repeated.
        label_settings: Label settings whose labels are the keypoints, without a network: paper or
            dense, or a file; may be repeated.
    """
    pairs, failures = [], []
    for scene in scenes:
        try:
            pairs.append(load_middlebury(scene))
        except DeepDetectError as error:
            failures.append(str(error))
    if not pairs:
        report_failures(failures, len(scenes), "scenes")
    sources: dict[str, HeatmapDetector] = {}
    for name in label_settings or ():
        sources[f"labels {name}"] = LabelDetector(find_label_settings(name))
    for name in weights or (() if label_settings else PRETRAINED):
        sources[f"weights {name}"] = DeepDetect(name)
    rows = score_stereo_matches(sources, pairs, quiet=as_json)
    if as_json:
        print_json(rows)
    else:
        width = max(len(row["source"]) for row in rows)
        print(
            f"{'keypoints':<{width}}  {'pair':<12}{'density':>8}{'matches':>10}"
            f"{'correct':>10}{'precision':>11}"
        )
        for row in rows:
            score = row["score"]
            print(
                f"{row['source']:<{width}}  {row['pair']:<12}{row['density']:>8.3f}"
                f"{score['matches']:>10,}{score['correct']:>10,}{row['precision']:>11.3f}"
            )
    report_failures(failures, len(scenes), "scenes")
