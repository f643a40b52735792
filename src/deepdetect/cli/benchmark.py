"""`deepdetect benchmark`: the tables and figures of the paper, and what they are worth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from .._shared.errors import BatchError, OptionError
from .._shared.registry import look_up
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..evaluation.baselines.external import find_feature
from ..evaluation.benchmarks import BENCHMARKS, run_benchmarks
from ..evaluation.options import BASELINES, DEFAULT_PROTOCOLS, BenchmarkOptions
from ._detection import NETWORK
from ._options import From, Json, Output, output_folder, print_json, with_options


@with_options(NETWORK, From(PointDetector, "ranker"))
def benchmark(
    name: Annotated[str, Parameter(help=f"One of {', '.join(BENCHMARKS)}, or all.")],
    /,
    *,
    data: Path,
    output: Output = Path("benchmark"),
    protocol: list[Literal["paper", "standard", "guided", "degraded"]] | None = None,
    degraded_images: Literal["second", "both"] = "second",
    method: list[str] | None = None,
    baselines: str | None = None,
    preset: Literal["default", "published"] = "default",
    cache: Path | None = None,
    geometry_weights: list[str] | None = None,
    max_pairs: int = 60,
    max_photographs: int = 20,
    as_json: Json = False,
    **values: Any,
) -> None:
    """Write a report on the detectors: report.md with figures, tables/*.csv, report.json.

    A second run does only what is new. What cannot be measured, as a data set that is missing, an
    image that is damaged or a method that fails, does not stop the rest: it is listed at the end,
    with exit code 1.

        deepdetect benchmark oxford --data data -o report
        deepdetect benchmark oxford --data data --max-pairs 1 --baselines sift -o quick
        deepdetect benchmark oxford --data data -o report --method xfeat.onnx
        deepdetect benchmark foreground --data data --baselines sift,fast-low -o report
        deepdetect benchmark pose --data data/fountain -o report
        deepdetect benchmark sfm --data data/fountain -o report

    Args:
        data: Folder of the data sets.
        output: Folder for the report.
        protocol: May be repeated.  [default: all but degraded]
        degraded_images: Protocol degraded: which images of a pair are made dark or blurred.
        method: A further method, NAME, FILE.onnx or MODULE:FUNCTION, as one more row; may be
            repeated.
        baselines: Classical methods to compare with, with commas between; none for none.
            [default: all 14]
        preset: published: show the network the channels as the paper's code does (BGR).
        cache: Folder of the stages' results.  [default: cache in the output]
        geometry_weights: Weights for stereo pairs, as --weights; may be repeated.  [default: dense]
        max_pairs: Of each scene at most this many pairs, evenly spaced; 1 for a first look.
        max_photographs: sfm: of each scene at most this many, of a sequence the first, else evenly
            spaced.
    """
    output = output_folder(output)
    if values.get("resolution") not in (None, "auto", "native"):
        raise OptionError(
            "the protocols fix the resolution (480x480 and native): leave out --resolution"
        )
    names = list(BENCHMARKS) if name == "all" else [name]
    for each in names:
        look_up("benchmark", each, BENCHMARKS)
    classical = tuple(BASELINES)
    if baselines is not None:
        listed = [word.strip() for word in baselines.split(",")]
        classical = tuple(word for word in listed if word not in ("", "none"))
    options = BenchmarkOptions(
        detector=DeepDetect(**NETWORK.take(values)),
        protocols=tuple(protocol or DEFAULT_PROTOCOLS),
        classical=classical,
        others=tuple(find_feature(word) for word in method or ()),
        channels="bgr" if preset == "published" else "rgb",
        geometry_weights=tuple(geometry_weights or ()) or ("dense",),
        max_pairs=max_pairs,
        degraded_images=degraded_images,
        max_images=max_photographs,
        ranker=values.get("ranker"),
    )
    report = run_benchmarks(names, data, options, cache=cache or output / "cache", quiet=as_json)
    paths = report.save(output)
    if as_json:
        print_json({**report.values(), "files": paths})
    else:
        for table in report.tables():
            if table.in_text:
                print(f"{table.title}\n\n{table.to_markdown()}\n")
        for reason in report.skipped:
            if reason not in report.failures:
                print(f"skipped: {reason}")
        print(f"report: {paths[0]}")
    if count := len(report.failures):
        what = "one part" if count == 1 else f"{count} parts"
        raise BatchError(
            f"{what} could not be measured, the rest is in {paths[0]}", report.failures
        )
