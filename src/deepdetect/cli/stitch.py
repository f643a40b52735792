"""`deepdetect stitch`: a panorama of overlapping images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .._shared.errors import ImageError, OptionError, RegistrationError
from .._shared.progress import stage_progress
from .._shared.records import Outputs
from ..detector.point_detector import PointDetector
from ..io.image import load_image
from ..matching.stitching import STAGES, Panorama, StitchingOptions
from ..matching.stitching import stitch as stitch_images
from ..viz.draw import picture_suffix, save_picture
from . import _options as cli
from ._detection import NETWORK, POINTS, Detector, chosen_detector

PANORAMA = cli.From(stitch_images, "projection crop seed", common="projection crop")
OPTIONS = cli.From(StitchingOptions)
MAX_KEYPOINTS = cli.From(PointDetector, "max_keypoints")


@cli.with_options(PANORAMA, OPTIONS, MAX_KEYPOINTS, POINTS, NETWORK)
def stitch(
    images: cli.Images,
    /,
    *,
    output: cli.Output = Path("panorama.jpg"),
    reference: Path | None = None,
    detector: Detector = "network",
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
    max_megapixels: cli.MaxMegapixels = 200,
    **values: Any,
) -> None:
    """Make a panorama of overlapping images from one place, or of a plane.

    They may be in any order. Those that overlap with no other are named. Those that cannot be read
    do not stop the others: they are listed at the end, with exit code 1. A flat panorama shows 100
    to 120 degrees at the most, a cylindrical or spherical one all around.

        deepdetect stitch left.jpg middle.jpg right.jpg -o panorama.jpg
        deepdetect stitch *.jpg --projection cylindrical --crop -o panorama.jpg

    Args:
        output: The panorama's file, or a folder for it.
        reference: The image that is not distorted, or in the middle of a curved panorama.
            [default: the one in the middle]
    """
    file = cli.output_file(output, "panorama.jpg")
    picture_suffix(file)  # before the work, which would else be lost
    cli.check_inputs_survive([file], images)
    if reference is not None and reference not in images:
        raise OptionError(f"--reference {reference} must be one of the images: name it there")
    if detector == "network" and "max_keypoints" in values:
        raise OptionError("--max-keypoints is for --detector points: leave it out, or choose that")
    chosen, _ = chosen_detector(detector, values)
    options = StitchingOptions(**OPTIONS.take(values))
    given = len(images)
    images, failures = _readable(images)
    if len(images) < min(given, 2) or (reference is not None and reference not in images):
        what = "too few images, or not the reference, can be read"
        raise ImageError(f"there is no panorama, as {what}: {'; '.join(failures)}")
    with cli.writing(Outputs([file], images, overwrite=overwrite)):
        try:
            with stage_progress("stitching", STAGES) as done:
                panorama = stitch_images(
                    images,
                    detector=chosen,
                    reference=None if reference is None else images.index(reference),
                    options=options,
                    progress=done,
                    **values,
                )
        except (OptionError, RegistrationError) as error:  # they name images by their number
            text = str(error)
            for number, path in enumerate(images):
                text = text.replace(f"images[{number}]", str(path))
            raise type(error)(text) from error
        save_picture(panorama.image, file)
    numbers = {**_numbers(panorama, images, file), "failures": failures}
    cli.print_result(as_json, numbers)
    if not as_json:
        for other in numbers["unregistered"]:
            cli.note(f"not in the panorama: {other['image']}, as {other['reason']}")
    cli.report_failures(failures, given)


def _readable(images: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Return the images that can be read, and a sentence on each of the others."""
    readable, failures = [], []
    for path in images:
        try:
            load_image(path)
        except ImageError as error:
            failures.append(str(error))
        else:
            readable.append(path)
    return readable, failures


def _numbers(panorama: Panorama, images: Sequence[Path], output: Path) -> dict[str, Any]:
    """Make what --json prints."""
    height, width = panorama.valid.shape
    used = sorted(panorama.homographies)
    return {
        "images": [images[k] for k in used],
        "unregistered": [
            {"image": images[k], "reason": reason} for k, reason in panorama.unregistered.items()
        ],
        "reference": images[panorama.reference],
        "width": width,
        "height": height,
        "covered": round(float(panorama.valid.mean()), 4),
        "homographies": [panorama.homographies[k].tolist() for k in used],
        "gains": [round(panorama.gains[k], 4) for k in used],
        "pairs": [
            {"images": [images[first], images[second]], "matches": count}
            for (first, second), count in panorama.matches.items()
        ],
        "residual_px": round(panorama.residual_px, 4),
        "seconds": {stage: round(value, 4) for stage, value in panorama.seconds.items()},
        "file": output,
    }
