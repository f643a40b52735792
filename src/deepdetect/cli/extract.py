"""`deepdetect extract`: features of a collection of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import generated_command
from ._options import (
    DETECTOR,
    PATH,
    POINTS,
    SELECTION,
    chosen_detector,
    detector_option,
    engine_option,
    json_option,
    max_megapixels_option,
    overwrite_option,
    print_json,
    processes_option,
)


@generated_command(
    SELECTION, POINTS, DETECTOR, short_help="Features of a collection of photographs."
)
@click.argument("folder", type=PATH)
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("features.h5"),
    show_default=True,
    help="File for the features.",
)
@detector_option("points")
@max_megapixels_option
@engine_option
@processes_option
@overwrite_option
@json_option
def extract(
    folder: Path,
    output: Path,
    kind: str,
    engine: str,
    workers: int | None,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Extract the keypoints and RootSIFT descriptors of all images below FOLDER.

    Writes one HDF5 file in the layout of hloc, with float32 and int32 numbers. When it is
    interrupted or killed, the same command goes on; new and changed images are added later, and
    the features of images that are gone are removed.
    An image that cannot be read does not stop the others: they are listed at the end, with exit
    code 1.

    \b
    deepdetect extract photos/ -o features.h5
    deepdetect extract photos/ -o features.h5 --engine ray --workers 64
    deepdetect match-many features.h5 --pairs pairs.txt
    """
    from ..batch.extraction import extract_features
    from ._records import check_none_made

    check_none_made(folder, output)
    detector, selection = chosen_detector(kind, values, threads=1)  # one a process
    report = extract_features(
        folder,
        output,
        detector,
        selection=selection,
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=False,
    )
    if as_json:
        print_json(
            {
                "path": report.path,
                "images": list(report.counts),
                "skipped": report.skipped,
                "keypoints": sum(report.counts.values()),
                "failures": report.failures,
            }
        )
    else:
        click.echo(
            f"{len(report.counts)} images with {sum(report.counts.values()):,} keypoints, "
            f"{report.skipped} already done" + (f" -> {output}" if output.exists() else "")
        )
    report.check()
