"""`deepdetect extract`: features of a collection of photographs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    DETECTOR,
    PATH,
    SELECTION,
    engine_option,
    json_option,
    max_megapixels_option,
    overwrite_option,
    print_json,
    processes_option,
)

EXTRACTED = FieldOptions(
    SELECTION.path,
    skip=SELECTION.skip,
    defaults={**SELECTION.defaults, "max_keypoints": "2048, but all with --mode dense"},
)


@generated_command(EXTRACTED, DETECTOR, short_help="Features of a collection of photographs.")
@click.argument("folder", type=PATH)
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("features.h5"),
    show_default=True,
    help="File for the features.",
)
@max_megapixels_option
@engine_option
@processes_option
@overwrite_option
@json_option
def extract(
    folder: Path,
    output: Path,
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
    from ..batch.extraction import MAX_KEYPOINTS, extract_features
    from ..features.selection import SelectionOptions
    from ._records import check_none_made

    check_none_made(folder, output)
    detector = given_only({name: values.pop(name) for name in DETECTOR.names})
    given = given_only(values)
    if given.get("mode") != "dense":
        given.setdefault("max_keypoints", MAX_KEYPOINTS)
    report = extract_features(
        folder,
        output,
        selection=SelectionOptions(**given),
        detector=detector,
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=False,
    )
    if as_json:
        print_json(vars(report))
    else:
        click.echo(
            f"{len(report.images)} images with {report.keypoints:,} keypoints, "
            f"{report.skipped} already done" + (f" -> {output}" if output.exists() else "")
        )
    report.check()
