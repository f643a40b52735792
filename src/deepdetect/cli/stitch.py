"""`deepdetect stitch`: a panorama of overlapping photographs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._shared.errors import DeepDetectError, ImageError, OptionError, RegistrationError
from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    DETECTOR,
    PATH,
    POINTS,
    check_inputs_survive,
    chosen_detector,
    detector_option,
    json_option,
    max_megapixels_option,
    overwrite_option,
    print_result,
    report_failures,
    seconds_rows,
)

if TYPE_CHECKING:
    from ..matching.stitching import Panorama

PANORAMA = FieldOptions(
    "matching.stitching.panorama:stitch",
    names=("projection", "crop", "seed"),
)
OPTIONS = FieldOptions(
    "matching.stitching.panorama:StitchingOptions",
    names=("scale", "max_canvas_megapixels", "registration_side"),
)
MAX_KEYPOINTS = FieldOptions(POINTS.path, names=("max_keypoints",))


@generated_command(
    *(PANORAMA, OPTIONS, MAX_KEYPOINTS, POINTS, DETECTOR),
    short_help="A panorama of overlapping images.",
)
@click.argument("images", type=PATH, nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("panorama.jpg"),
    show_default=True,
    help="The panorama's file.",
)
@click.option(
    "--reference",
    type=PATH,
    help="The one of IMAGES that is not distorted, or in the middle of a curved panorama.  "
    "[default: the one in the middle]",
)
@detector_option("network")
@max_megapixels_option
@overwrite_option
@json_option
def stitch(
    images: tuple[Path, ...],
    output: Path,
    reference: Path | None,
    kind: str,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Make a panorama of IMAGES: overlapping ones from one place, or of a plane.

    They may be in any order. Those that overlap with no other are named. Those that cannot be read
    do not stop the others: they are listed at the end, with exit code 1. A flat panorama shows 100
    to 120 degrees at the most, a cylindrical or spherical one all around.

    \b
    deepdetect stitch left.jpg middle.jpg right.jpg -o panorama.jpg
    deepdetect stitch *.jpg --projection cylindrical --crop -o panorama.jpg
    """
    from .._shared.progress import stage_progress
    from ..matching.stitching import STAGES, StitchingOptions
    from ..matching.stitching import stitch as stitch_images
    from ..viz.draw import picture_suffix, save_picture
    from ._records import claimed_outputs

    # Before the work, which would else be lost.
    picture_suffix(output)
    check_inputs_survive([output], images, "give the panorama another name by -o")
    if reference is not None and reference not in images:
        raise OptionError(f"--reference {reference} must be one of the photographs: name it there")
    if kind == "network" and values["max_keypoints"] is not None:
        raise OptionError("--max-keypoints is for --detector points: leave it out, or choose that")
    detector, _ = chosen_detector(kind, values)
    options = StitchingOptions(**given_only({name: values.pop(name) for name in OPTIONS.names}))
    given = len(images)
    images, failures = _readable(images)
    if len(images) < min(given, 2) or (reference is not None and reference not in images):
        what = "too few photographs, or not the reference, can be read"
        raise ImageError(f"there is no panorama, as {what}: {'; '.join(failures)}")
    with claimed_outputs("stitch", images, [output], overwrite):
        try:
            with stage_progress("stitching", STAGES) as done:
                panorama = stitch_images(
                    images,
                    detector=detector,
                    reference=None if reference is None else images.index(reference),
                    options=options,
                    progress=done,
                    **given_only(values),
                )
        except DeepDetectError as error:
            if type(error) not in (
                DeepDetectError,
                OptionError,
                RegistrationError,
            ):  # an image, named as it was given
                raise
            text = str(error)
            for number, path in enumerate(images):
                text = text.replace(f"images[{number}]", str(path))
            raise type(error)(text) from error
        save_picture(panorama.image, output)
    numbers = {**_numbers(panorama, images, output), "failures": failures}
    print_result(as_json, numbers, _rows(panorama, images, output), "panorama")
    if not as_json:
        for other in numbers["unregistered"]:
            click.echo(f"not in the panorama: {other['image']}, as {other['reason']}", err=True)
    report_failures(failures, given)


def _readable(images: Sequence[Path]) -> tuple[tuple[Path, ...], list[str]]:
    """Return the photographs that can be read, and a sentence on each of the others."""
    from ..io.image import load_image

    readable, failures = [], []
    for path in images:
        try:
            load_image(path)
        except ImageError as error:
            failures.append(str(error))
        else:
            readable.append(path)
    return tuple(readable), failures


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


def _rows(panorama: Panorama, images: Sequence[Path], output: Path) -> list[tuple[str, str]]:
    """Make the table of the terminal."""
    height, width = panorama.valid.shape
    counts, gains = panorama.matches.values(), panorama.gains.values()
    return [
        ("photographs", f"{len(panorama.homographies)} of {len(images)}"),
        ("reference", str(images[panorama.reference])),
        ("registered pairs", f"{len(counts)}, with {min(counts):,} to {max(counts):,} matches"),
        ("residual", f"{panorama.residual_px:.2f} px (root mean square, reduced images)"),
        ("brightness", f"changed by {min(gains):.2f} to {max(gains):.2f} times"),
        ("size", f"{width}x{height}, {panorama.valid.mean():.0%} covered"),
        *seconds_rows(panorama.seconds),
        ("written", str(output)),
    ]
