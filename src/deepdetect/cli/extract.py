"""`deepdetect extract`: features of a collection of images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..batch.extraction import extract_features
from . import _options as cli
from ._detection import NETWORK, POINTS, SELECTION, Detector, chosen_detector


@cli.with_options(SELECTION, POINTS, NETWORK)
def extract(
    folder: Annotated[Path, Parameter(help="Folder of the images.")],
    /,
    *,
    output: cli.Output = Path("features.h5"),
    detector: Detector = "points",
    engine: cli.Engine = "processes",
    workers: cli.Workers = None,
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
    max_megapixels: cli.MaxMegapixels = 200,
    **values: Any,
) -> None:
    """Extract the keypoints and RootSIFT descriptors of all images below a folder.

    Writes one HDF5 file in the layout of hloc, with float32 and int32 numbers. When it is
    interrupted or killed, the same command goes on; new and changed images are added later, and
    the features of images that are gone are removed. An image that cannot be read does not stop
    the others: they are listed at the end, with exit code 1.

        deepdetect extract photos/ -o features.h5
        deepdetect extract photos/ -o features.h5 --engine ray --workers 64
        deepdetect match-many features.h5 --pairs pairs.txt

    Args:
        output: File for the features, or a folder for it.
    """
    file = cli.output_file(output, "features.h5")
    cli.check_folder_not_made(folder, file)
    chosen, selection = chosen_detector(detector, values, threads=1)  # one a process
    report = extract_features(
        folder,
        file,
        chosen,
        selection=selection,
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=False,
    )
    if as_json:
        cli.print_json(
            {
                "path": report.path,
                "images": list(report.counts),
                "skipped": report.skipped,
                "keypoints": sum(report.counts.values()),
                "failures": report.failures,
            }
        )
    else:
        print(
            f"{len(report.counts)} images with {sum(report.counts.values()):,} keypoints, "
            f"{report.skipped} already done" + (f" -> {file}" if file.exists() else "")
        )
    report.check()
