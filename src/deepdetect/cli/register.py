"""`deepdetect register`: one image registered to another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._shared.progress import stage_progress
from .._shared.records import Outputs
from ..matching.registration import register as register_images
from ..viz.draw import save_picture
from . import _options as cli
from ._detection import NETWORK, POINTS, SELECTION, Detector, chosen_detector

STAGES = ("keypoints", "guided matching", "geometry")


@cli.with_options(SELECTION, POINTS, NETWORK)
def register(
    image0: cli.Image,
    image1: cli.Image,
    /,
    *,
    output: cli.Folder = Path("deepdetect-output"),
    detector: Detector = "network",
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
    max_megapixels: cli.MaxMegapixels = 200,
    **values: Any,
) -> None:
    """Register the second image to the first: for planes, and for images from one place.

    Writes STEM1_on_STEM0.png (the second image in the frame of the first), the same as
    _checkerboard.png and _difference.png with the first, and _homography.txt (3x3, from the
    first image to the second).

        deepdetect register map.jpg photo-of-the-map.jpg -o registered
    """
    stem = cli.output_folder(output) / f"{image1.stem}_on_{image0.stem}"
    endings = (".png", "_checkerboard.png", "_difference.png", "_homography.txt")
    files = {ending: stem.with_name(stem.name + ending) for ending in endings}
    cli.check_inputs_survive(files.values(), [image0, image1])
    chosen, selection = chosen_detector(detector, values)
    with cli.writing(Outputs([*files.values()], [image0, image1], overwrite=overwrite)):
        with stage_progress("registering", STAGES) as done:
            found = register_images(image0, image1, chosen, selection=selection, progress=done)
        with cli.whole(files) as made:
            for ending, picture in zip(
                endings, (found.warped, found.checkerboard(), found.difference()), strict=False
            ):
                save_picture(picture, made[ending])
            np.savetxt(made["_homography.txt"], found.homography, fmt="%.12e")
    numbers = {
        "image0": image0,
        "image1": image1,
        "homography": found.homography.tolist(),
        "matches": found.matches,
        "overlap": round(float(found.valid.mean()), 4),
        "correlation": round(found.zncc, 4),
        "files": [*files.values()],
    }
    cli.print_result(as_json, numbers)
