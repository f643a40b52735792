"""`deepdetect reconstruct` with a folder, or with three or more images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from .._shared.errors import OptionError
from .._shared.records import Outputs, check_not_made
from ..sfm.colmap import import_pycolmap
from ..sfm.options import MultiViewOptions
from ..sfm.pipeline import MAX_KEYPOINTS, check_output_folder, output_files, reconstruct_many
from ..sfm.stages import check_images
from ._detection import Kind, chosen_detector
from ._options import From, print_result

MANY = From(
    MultiViewOptions,
    flags={"stride_px": "--stride", "single_camera": "--single-camera/--camera-each"},
)
"""Options that two images do not have."""

MAX_UNREGISTERED = 10
"""Images that are named with a reason on the terminal."""


def reconstruct_folder(
    images: Sequence[Path],
    output: Path,
    kind: Kind,
    workers: int | None,
    overwrite: bool,
    as_json: bool,
    values: dict[str, Any],
) -> None:
    """Reconstruct many images, and print what was found."""
    if "rectified" in values:
        raise OptionError("--rectified and --not-rectified are for two images")
    detector, selection = chosen_detector(kind, values, max_keypoints=MAX_KEYPOINTS, threads=1)
    source: Path | Sequence[Path] = images[0] if len(images) == 1 else images
    many = MANY.take(values)
    if "sequential" in many:
        many.setdefault("pairs", "sequential")
    # What is missing or wrong is said before anything is written.
    import_pycolmap()
    check_output_folder(output)
    found_images = check_images(source)
    if isinstance(source, Path):
        check_not_made(source, found_images.values())
    outputs = Outputs(output_files(output), sorted(images), overwrite=overwrite, growing=True)
    with outputs.writing():
        reconstruct_many(
            source,
            output,
            detector,
            selection=selection,
            options=MultiViewOptions(**many),
            workers=workers,
            overwrite=overwrite,
            quiet=False,
            **values,
        )
    numbers = json.loads((output / "model.json").read_text(encoding="utf-8"))
    if not as_json:  # model.json names all, and where each camera is
        numbers["unregistered"] = dict(islice(numbers["unregistered"].items(), MAX_UNREGISTERED))
        del numbers["cameras"]
    print_result(as_json, numbers)
