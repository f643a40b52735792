"""`deepdetect match-many`: matches of many pairs of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    PATH,
    engine_option,
    json_option,
    overwrite_option,
    print_json,
    processes_option,
)

MATCHING = FieldOptions("batch.pair_matching:PairMatchingOptions")


@generated_command(MATCHING, short_help="Matches of many pairs of photographs.")
@click.argument("features", type=PATH)
@click.option(
    "--pairs",
    type=PATH,
    required=True,
    help="Text file with the names of two images on each line, as hloc writes it.",
)
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("matches.h5"),
    show_default=True,
    help="File for the matches.",
)
@engine_option
@processes_option
@overwrite_option
@json_option
def match_many(
    features: Path,
    pairs: Path,
    output: Path,
    engine: str,
    workers: int | None,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Match the descriptors in FEATURES, a file of `deepdetect extract` or of hloc, pair by pair.

    Writes one HDF5 file in the layout of hloc, with float32 and int32 numbers. When it is
    interrupted or killed, the same command goes on; new pairs are added later. Pairs of which
    an image has no features do not stop the others: they are listed at the end, with exit code 1.

    \b
    deepdetect match-many features.h5 --pairs pairs.txt -o matches.h5
    deepdetect match-many features.h5 --pairs pairs.txt --verify fundamental
    """
    from ..batch.pair_matching import PairMatchingOptions, match_pairs

    report = match_pairs(
        features,
        pairs,
        output,
        options=PairMatchingOptions(**given_only(values)),
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=False,
    )
    total = sum(report.counts.values())
    if as_json:
        matched = [{"pair": pair, "matches": count} for pair, count in report.counts.items()]
        print_json(
            {
                "path": report.path,
                "matches": matched,
                "skipped": report.skipped,
                "failures": report.failures,
            }
        )
    else:
        click.echo(
            f"{len(report.counts)} pairs with {total:,} matches, {report.skipped} already done"
            + (f" -> {output}" if output.exists() else "")
        )
    report.check()
