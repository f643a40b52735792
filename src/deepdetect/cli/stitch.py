"""`deepdetect stitch`: a panorama of overlapping photographs."""

from __future__ import annotations

from pathlib import Path

import click

from .shared import PATH, check_inputs_survive, json_option, print_json, print_table


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
@json_option
def stitch(images: tuple[Path, ...], output: Path, as_json: bool) -> None:
    """Make a panorama of IMAGES: overlapping photographs from one place, in any order.

    \b
    deepdetect stitch left.jpg middle.jpg right.jpg -o panorama.jpg
    """
    from ..matching.stitching import stitch as stitch_images
    from ..viz.draw import picture_ending, save_picture

    # Before the work, which would else be lost.
    picture_ending(output)
    check_inputs_survive([output], images, "give the panorama another name by -o")
    panorama = stitch_images(images)
    save_picture(panorama.picture, output)
    height, width = panorama.picture.shape[:2]
    left_out = [path for k, path in enumerate(images) if k not in panorama.used]
    if as_json:
        used = [images[k] for k in panorama.used]
        size = {"width": width, "height": height}
        print_json({"images": used, "left_out": left_out, **size, "file": output})
        return
    rows = [
        ("photographs", f"{len(panorama.used)} of {len(images)}"),
        ("size", f"{width}x{height}"),
        ("written", str(output)),
    ]
    print_table(rows, "panorama")
    for path in left_out:
        click.echo(f"left out, for want of overlap: {path}", err=True)
