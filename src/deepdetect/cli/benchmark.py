"""`deepdetect benchmark`: the tables and figures of the paper, and what they are worth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .shared import PATH, detector_options, json_option, make_detector, print_json

NAMES = (
    *("oxford", "hpatches", "middlebury", "foreground", "low-visibility", "speed", "all"),
    "refine-oxford",
)


@click.command(short_help="The tables and figures of the paper, and their controls.")
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
    help="paper, standard or guided; may be repeated.  [default: all]",
)
@click.option(
    "--method",
    "words",
    multiple=True,
    metavar="NAME|FILE.onnx|MODULE:FUNCTION",
    help="A further method as one more row; may be repeated.",
)
@click.option(
    "--only",
    metavar="NAMES",
    help="Classical methods, with commas between; none for none.  [default: all 14]",
)
@click.option(
    "--preset",
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
    help="Weights for stereo pairs, as --weights; may be repeated.  [default: geometry]",
)
@detector_options
@json_option
def benchmark(
    name: str,
    data: Path,
    output: Path,
    protocols: tuple[str, ...],
    words: tuple[str, ...],
    only: str | None,
    preset: str,
    cache: Path | None,
    geometry_weights: tuple[str, ...],
    as_json: bool,
    **values: Any,
) -> None:
    """Write a report on the detectors: index.html, report.md, tables/*.csv, report.json.

    NAME is one of the data sets or all. A second run does only what is new. The name refine-oxford
    judges nothing: it writes more accurate homographies of the Oxford scenes, SCENE/H1toKp.refined.

    \b
    deepdetect benchmark oxford --data data -o report
    deepdetect benchmark oxford --data data -o report --method xfeat.onnx
    deepdetect benchmark foreground --data data --only sift,fast-low -o report
    deepdetect benchmark refine-oxford --data data/oxford -o refined
    """
    if name == "refine-oxford":
        _refine_oxford(data, output, as_json)
        return
    from .._shared.errors import OptionError
    from .._shared.registry import look_up
    from ..evaluation.baselines import CLASSICAL, find_method
    from ..evaluation.formats import report_values, save_report, table_text
    from ..evaluation.protocols import BENCHMARKS, PROTOCOLS, BenchmarkOptions, run_benchmarks
    from ..matching.options import get_preset

    if values["resolution"] != "native":
        raise OptionError(
            "the protocols fix the resolution (480x480 and native): leave out --resolution"
        )
    names = list(BENCHMARKS) if name == "all" else [name]
    for each in names:
        look_up("benchmark", each, dict.fromkeys(NAMES))
    heatmap = get_preset(preset).heatmap
    classical = tuple(CLASSICAL)
    if only is not None:
        classical = tuple(
            word.strip() for word in only.split(",") if word.strip() not in ("", "none")
        )
    options = BenchmarkOptions(
        make_detector(values),
        protocols or PROTOCOLS,
        classical,
        tuple(find_method(word) for word in words),
        "rgb" if heatmap is None else heatmap.channels,
        geometry_weights,
    )
    report = run_benchmarks(names, data, options, cache=cache or output / "cache", quiet=as_json)
    paths = save_report(report, output)
    if as_json:
        print_json({**report_values(report), "files": paths})
        return
    for table in report.tables():
        click.echo(f"{table.title}\n\n{table_text(table)}\n")
    for reason in report.left_out:
        click.echo(f"left out: {reason}")
    click.echo(f"report: {paths[0]}")


def _refine_oxford(data: Path, output: Path, as_json: bool) -> None:
    from .._shared.progress import progress
    from .._shared.provenance import provenance
    from ..evaluation.formats import report_values, save_report, table_text
    from ..evaluation.protocols.refine_oxford import refine_oxford, refinement_table
    from ..evaluation.report import Report, Section

    folder = data / "oxford" if (data / "oxford").is_dir() else data
    with progress(40, "refining", "pair", as_json) as bar:
        results = refine_oxford(folder, output, bar.update)
    table = refinement_table(results)
    section = Section("Oxford's homographies, refined", (), (table,))
    report = Report("DeepDetect: refined homographies of Oxford", provenance(), (section,))
    paths = save_report(report, output / "refinement")
    written = [result.written for result in results if result.written]
    if as_json:
        print_json({**report_values(report), "files": [*paths, *written]})
        return
    click.echo(f"{table_text(table)}\n\n{len(written)} files H1toKp.refined written to {output}")
