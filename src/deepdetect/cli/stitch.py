"""`deepdetect stitch`: a panorama of overlapping photographs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._shared.errors import DeepDetectError, OptionError
from ._options import (
    PATH,
    check_inputs_survive,
    detector_options,
    json_option,
    make_detector,
    print_json,
    print_table,
    seconds_rows,
)

if TYPE_CHECKING:
    from ..matching.stitching import Panorama


@click.command(short_help="A panorama of overlapping photographs.")
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
    help="The one of IMAGES that is not distorted.  [default: the one in the middle]",
)
@click.option(
    "--scale",
    type=float,
    default=1.0,
    show_default=True,
    help="Pixels of the panorama per pixel of the reference.",
)
@click.option(
    "--max-canvas-megapixels",
    type=float,
    default=50.0,
    show_default=True,
    help="Refuse a larger panorama, before it takes any memory.",
)
@click.option(
    "--registration-side",
    type=int,
    default=640,
    show_default=True,
    help="Longer side to which photographs are reduced to be registered, pixels.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the random choices.")
@detector_options
@json_option
def stitch(
    images: tuple[Path, ...],
    output: Path,
    reference: Path | None,
    scale: float,
    max_canvas_megapixels: float,
    registration_side: int,
    seed: int,
    as_json: bool,
    **values: Any,
) -> None:
    """Make a flat panorama of IMAGES: overlapping photographs from one place, or of a plane.

    They may be in any order. Those that overlap with no other are left out and named. A flat
    panorama shows 100 to 120 degrees at the most.

    \b
    deepdetect stitch left.jpg middle.jpg right.jpg -o panorama.jpg
    """
    from ..matching.stitching import stitch as stitch_images
    from ..viz.draw import picture_suffix, save_picture

    # Before the work, which would else be lost.
    picture_suffix(output)
    check_inputs_survive([output], images, "give the panorama another name by -o")
    if reference is not None and reference not in images:
        raise OptionError(f"--reference {reference} must be one of the photographs: name it there")
    detector = make_detector(values)
    try:
        panorama = stitch_images(
            images,
            detector=detector,
            reference=None if reference is None else images.index(reference),
            scale=scale,
            max_canvas_megapixels=max_canvas_megapixels,
            registration_side=registration_side,
            seed=seed,
        )
    except DeepDetectError as error:
        if type(error) not in (DeepDetectError, OptionError):  # an image, named as it was given
            raise
        raise type(error)(_worded(str(error), images)) from error
    save_picture(panorama.image, output)
    numbers = _numbers(panorama, images, output)
    if as_json:
        print_json(numbers)
        return
    print_table(_rows(panorama, images, output), "panorama")
    for left_out in numbers["left_out"]:
        click.echo(f"left out: {left_out['image']}, as {left_out['reason']}", err=True)


def _worded(message: str, images: Sequence[Path]) -> str:
    """Speak of files and flags where the library speaks of numbers and parameters."""
    for name in ("max_canvas_megapixels", "registration_side", "scale", "reference between"):
        message = message.replace(name, f"--{name.replace('_', '-')}")
    return re.sub(r"images\[(\d+)\]", lambda found: str(images[int(found[1])]), message)


def _numbers(panorama: Panorama, images: Sequence[Path], output: Path) -> dict[str, Any]:
    """Make what --json prints."""
    height, width = panorama.valid.shape
    used = sorted(panorama.homographies)
    return {
        "images": [images[k] for k in used],
        "left_out": [
            {"image": images[k], "reason": reason} for k, reason in panorama.left_out.items()
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
        ("residual", f"{panorama.residual_px:.2f} px (root mean square, reduced photographs)"),
        ("brightness", f"changed by {min(gains):.2f} to {max(gains):.2f} times"),
        ("size", f"{width}x{height}, {panorama.valid.mean():.0%} covered"),
        *seconds_rows(panorama.seconds),
        ("written", str(output)),
    ]
