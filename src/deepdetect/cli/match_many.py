"""`deepdetect match-many`: matches of many pairs of images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from ..batch.pair_matching import PairMatchingOptions, match_pairs
from ..features.matchers import MATCHERS
from . import _options as cli

MATCHING = cli.From(
    PairMatchingOptions,
    common="ratio mutual verify",
    types={
        "matcher": Literal[tuple(name for name in MATCHERS if name != "hamming")],
        "verify": Literal["none", "fundamental", "homography", "auto"],
    },
)


@cli.with_options(MATCHING)
def match_many(
    features: Annotated[Path, Parameter(help="File of `deepdetect extract`, or of hloc.")],
    /,
    *,
    pairs: Path,
    output: cli.Output = Path("matches.h5"),
    engine: cli.Engine = "processes",
    workers: cli.Workers = None,
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
    **values: Any,
) -> None:
    """Match the descriptors in a file of features, pair by pair.

    Writes one HDF5 file in the layout of hloc, with float32 and int32 numbers. When it is
    interrupted or killed, the same command goes on; new pairs are added later. Pairs of which
    an image has no features do not stop the others: they are listed at the end, with exit code 1.

        deepdetect match-many features.h5 --pairs pairs.txt -o matches.h5
        deepdetect match-many features.h5 --pairs pairs.txt --verify fundamental

    Args:
        pairs: Text file with the names of two images on each line, as hloc writes it.
        output: File for the matches, or a folder for it.
    """
    file = cli.output_file(output, "matches.h5")
    report = match_pairs(
        features,
        pairs,
        file,
        options=PairMatchingOptions(**values),
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=False,
    )
    if as_json:
        cli.print_json(
            {
                "path": report.path,
                "matches": [{"pair": p, "matches": count} for p, count in report.counts.items()],
                "skipped": report.skipped,
                "failures": report.failures,
            }
        )
    else:
        print(
            f"{len(report.counts)} pairs with {sum(report.counts.values()):,} matches, "
            f"{report.skipped} already done" + (f" -> {file}" if file.exists() else "")
        )
    report.check()
