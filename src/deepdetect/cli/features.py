"""`deepdetect extract` and `match-many`: features and matches of many images."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from ..batch.extraction import extract_features
from ..batch.hdf5 import BatchReport
from ..batch.pair_matching import PairMatchingOptions, match_pairs
from ..features.matchers import MATCHERS_OF_NUMBERS
from . import _options as cli
from ._detection import DESCRIBED_POINTS, ONE_THREAD, SELECTION, Detector, chosen_detector

EXTRACTION = cli.From(extract_features, "overwrite", more="engine workers")
PAIRS = cli.From(match_pairs, "overwrite", more="engine workers")
MATCHING = cli.From(
    PairMatchingOptions,
    "filter_by ratio mutual verify",
    types={
        "matcher": Literal[MATCHERS_OF_NUMBERS],
        "verify": Literal["fundamental", "homography", "auto"],
    },
)


@cli.command(EXTRACTION, SELECTION, DESCRIBED_POINTS, ONE_THREAD, cli.READING)
def extract(
    folder: Annotated[Path, Parameter(help="Folder of the images.")],
    /,
    *,
    output: cli.Output = Path("features.h5"),
    detector: Detector = "points",
    **values: Any,
) -> cli.Result:
    """Extract the keypoints and descriptors of all images below a folder.

    Writes one HDF5 file in the layout of hloc, with float32 and int32 numbers. Run the same command
    again to resume, or to update the file for new, changed and deleted images.

        deepdetect extract photos/ -o features.h5
        deepdetect extract photos/ -o features.h5 --engine ray --workers 64
        deepdetect match-many features.h5 --pairs exhaustive

    Args:
        output: File for the features, or a folder for it.
    """
    file = cli.output_file(output, "features.h5")
    how = EXTRACTION.take(values)
    chosen, selection = chosen_detector(  # one thread: each process gets a copy
        detector, values, options=DESCRIBED_POINTS, threads=1
    )
    report = extract_features(folder, file, chosen, selection=selection, quiet=False, **how)
    keypoints = sum(report.counts.values())
    return _result(report, "keypoints", images=[*report.counts], keypoints=keypoints)


@cli.command(PAIRS, MATCHING)
def match_many(
    features: Annotated[Path, Parameter(help="Features file of `deepdetect extract` or hloc.")],
    /,
    *,
    pairs: str,
    output: cli.Output = Path("matches.h5"),
    **values: Any,
) -> cli.Result:
    """Match the descriptors in a file of features, pair by pair.

    Writes one HDF5 file in the layout of hloc, with float32 and int32 numbers. Run the same command
    again to resume after an interruption, or to add the pairs that are new.

        deepdetect match-many features.h5 --pairs exhaustive
        deepdetect match-many features.h5 --pairs similar --verify fundamental
        deepdetect match-many features.h5 --pairs pairs.txt -o matches.h5

    Args:
        pairs: Which pairs to match: exhaustive (all), sequential:10 (each image with the 10 that
            follow it by name), similar:20 (each image with the 20 most similar), or a text file
            with the names of two images on each line, as hloc writes it.
        output: File for the matches, or a folder for it.
    """
    file = cli.output_file(output, "matches.h5")
    how = PAIRS.take(values)
    options = PairMatchingOptions(**values)
    report = match_pairs(features, pairs, file, options=options, quiet=False, **how)
    matches = [{"pair": pair, "matches": count} for pair, count in report.counts.items()]
    return _result(report, "matches", matches=matches)


def _result(report: BatchReport, unit: str, **listed: Any) -> cli.Result:
    count, total = len(report.counts), sum(report.counts.values())
    skipped, failures = report.skipped, report.failures
    text = f"{count} {report.of} with {total:,} {unit}, {skipped} already done"
    text += f" -> {report.path}" if report.path.exists() else ""
    values = {"path": report.path, **listed, "skipped": skipped, "failures": failures}
    return cli.Result(values, text, failures, count + skipped + len(failures), report.of)
