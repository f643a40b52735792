"""`deepdetect register`: one photograph registered to another."""

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
    check_inputs_survive,
    chosen_detector,
    detector_option,
    json_option,
    max_megapixels_option,
    output_option,
    overwrite_option,
    print_result,
)

STAGES = ("keypoints", "guided matching", "geometry")


@generated_command(SELECTION, POINTS, DETECTOR, short_help="One photograph registered to another.")
@click.argument("image0", type=PATH)
@click.argument("image1", type=PATH)
@output_option
@detector_option("network")
@max_megapixels_option
@overwrite_option
@json_option
def register(
    image0: Path,
    image1: Path,
    output: Path,
    kind: str,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Register IMAGE1 to IMAGE0: for planes, and for photographs from one place.

    Writes STEM1_on_STEM0.png (the second image in the frame of the first), the same as
    _checkerboard.png and _difference.png with the first, and _homography.txt (3x3, from the
    first image to the second).

    \b
    deepdetect register map.jpg photo-of-the-map.jpg -o registered
    """
    import numpy as np

    from .._shared.atomic import atomic_path
    from .._shared.progress import stage_progress
    from ..matching.registration import register as register_images
    from ..viz.draw import save_picture
    from ._records import claimed_outputs

    stem = f"{image1.stem}_on_{image0.stem}"
    files = [output / f"{stem}{name}.png" for name in ("", "_checkerboard", "_difference")]
    files.append(output / f"{stem}_homography.txt")
    check_inputs_survive(files, [image0, image1], "choose another folder with -o")
    detector, selection = chosen_detector(kind, values)
    with claimed_outputs("register", [image0, image1], files, overwrite):
        with stage_progress("registering", STAGES) as done:
            found = register_images(image0, image1, detector, selection=selection, progress=done)
        pictures = found.warped, found.checkerboard(), found.difference()
        for path, picture in zip(files[:-1], pictures, strict=True):
            save_picture(picture, path)
        with atomic_path(files[-1]) as temporary:
            np.savetxt(temporary, found.homography, fmt="%.12e")
    numbers = {
        "image0": image0,
        "image1": image1,
        "homography": found.homography.tolist(),
        "matches": found.matches,
        "overlap": round(float(found.valid.mean()), 4),
        "correlation": round(found.zncc, 4),
        "files": files,
    }
    print_result(
        as_json,
        numbers,
        [
            ("matches", f"{found.matches:,}"),
            ("overlap", f"{numbers['overlap']:.1%} of the first image"),
            ("correlation", f"{found.zncc:.3f} (median of small windows; 1 is the same)"),
            ("written", ", ".join(str(path) for path in files)),
        ],
        f"{image1} on {image0}",
    )
