"""`deepdetect benchmark`: the tables and figures of the paper, and what they are worth."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import click

from ._generated import generated_command
from ._options import DETECTOR, PATH, POINTS, json_option, make_detector, print_json

NAMES = (
    *("oxford", "hpatches", "middlebury", "pose", "sfm"),
    *("foreground", "low-visibility", "speed"),
    "all",
)


RANKER = dataclasses.replace(POINTS, names=("ranker",))


@generated_command(
    DETECTOR, RANKER, short_help="The tables and figures of the paper, with baselines."
)
@click.argument("name", metavar="|".join(NAMES))
@click.option("--data", type=PATH, required=True, help="Folder of the data sets.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("benchmark"),
    show_default=True,
    help="For the report.",
)
@click.option(
    "--protocol",
    "protocols",
    multiple=True,
    help="paper, standard, guided or degraded; may be repeated.  [default: all but degraded]",
)
@click.option(
    "--degraded-images",
    metavar="second|both",
    default="second",
    show_default=True,
    help="degraded: which images of a pair are made dark or blurred.",
)
@click.option(
    "--method",
    "words",
    multiple=True,
    metavar="NAME|FILE.onnx|MODULE:FUNCTION",
    help="A further method as one more row; may be repeated.",
)
@click.option(
    "--baselines",
    metavar="NAMES",
    help="Classical methods to compare with, separated by commas; none for none.  "
    "[default: all 14]",
)
@click.option(
    "--preset",
    type=click.Choice(["default", "published"]),
    default="default",
    show_default=True,
    help="published: show the network the channels as the paper's code does (BGR).",
)
@click.option(
    "--cache", type=PATH, help="Folder of the stages' results.  [default: cache in the output]"
)
@click.option(
    "--geometry-weights",
    multiple=True,
    default=("dense",),
    help="Weights for stereo pairs, as --weights; may be repeated.  [default: dense]",
)
@click.option(
    "--max-pairs",
    type=int,
    default=60,
    show_default=True,
    help="Of each scene at most this many pairs, evenly spaced; 1 for a first look.",
)
@click.option(
    "--max-photographs",
    type=int,
    default=20,
    show_default=True,
    help="sfm: of each scene at most this many, of a sequence the first, else evenly spaced.",
)
@json_option
def benchmark(
    name: str,
    data: Path,
    output: Path,
    protocols: tuple[str, ...],
    degraded_images: Any,
    words: tuple[str, ...],
    baselines: str | None,
    preset: str,
    cache: Path | None,
    geometry_weights: tuple[str, ...],
    max_pairs: int,
    max_photographs: int,
    as_json: bool,
    **values: Any,
) -> None:
    """Write a report on the detectors: report.md with figures, tables/*.csv, report.json.

    NAME is one of the data sets or all. A second run does only what is new. What cannot be
    measured, as a data set that is missing, an image that is damaged or a method that fails, does
    not stop the rest: it is listed at the end, with exit code 1.

    \b
    deepdetect benchmark oxford --data data -o report
    deepdetect benchmark oxford --data data --max-pairs 1 --baselines sift -o quick
    deepdetect benchmark oxford --data data -o report --method xfeat.onnx
    deepdetect benchmark foreground --data data --baselines sift,fast-low -o report
    deepdetect benchmark pose --data data/fountain -o report
    deepdetect benchmark sfm --data data/fountain -o report
    """
    from .._shared.errors import BatchError, OptionError
    from .._shared.registry import look_up
    from ..evaluation.baselines.plugin import find_feature
    from ..evaluation.benchmarks import BENCHMARKS, run_benchmarks
    from ..evaluation.options import BASELINES, DEFAULT_PROTOCOLS, BenchmarkOptions

    if values["resolution"] not in (None, "auto", "native"):
        raise OptionError(
            "the protocols fix the resolution (480x480 and native): leave out --resolution"
        )
    names = list(BENCHMARKS) if name == "all" else [name]
    for each in names:
        look_up("benchmark", each, dict.fromkeys(NAMES))
    classical = tuple(BASELINES)
    if baselines is not None:
        listed = [word.strip() for word in baselines.split(",")]
        classical = tuple(word for word in listed if word not in ("", "none"))
    ranker = values.pop("ranker")
    options = BenchmarkOptions(
        make_detector(values),
        protocols or DEFAULT_PROTOCOLS,
        classical,
        tuple(find_feature(word) for word in words),
        "bgr" if preset == "published" else "rgb",
        geometry_weights,
        max_pairs,
        degraded_images,
        max_photographs,
        ranker,
    )
    report = run_benchmarks(names, data, options, cache=cache or output / "cache", quiet=as_json)
    paths = report.save(output)
    if as_json:
        print_json({**report.values(), "files": paths})
    else:
        for table in report.tables():
            if table.in_text:
                click.echo(f"{table.title}\n\n{table.to_markdown()}\n")
        for reason in report.skipped:
            if reason not in report.failures:
                click.echo(f"skipped: {reason}")
        click.echo(f"report: {paths[0]}")
    if count := len(report.failures):
        what = "one part" if count == 1 else f"{count} parts"
        raise BatchError(
            f"{what} could not be measured, the rest is in {paths[0]}", report.failures
        )
