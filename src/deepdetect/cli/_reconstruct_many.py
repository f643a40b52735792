"""`deepdetect reconstruct` with a folder, or with three or more images."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from .._shared.errors import OptionError
from .._shared.records import Outputs, check_not_made
from ..sfm.colmap import import_pycolmap
from ..sfm.options import MultiViewOptions
from ..sfm.pipeline import MAX_KEYPOINTS, check_output_folder, output_files, reconstruct_many
from ..sfm.result import MultiViewReconstruction
from ..sfm.stages import check_images
from ._detection import Kind, chosen_detector
from ._options import From, print_result, seconds_rows

MANY = From(
    MultiViewOptions,
    flags={"stride_px": "--stride", "single_camera": "--single-camera/--camera-each"},
)
"""Options that two images do not have."""

MAX_UNREGISTERED_ROWS = 10
"""Images that are named with a reason on the terminal; model.json names all."""


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
        found = reconstruct_many(
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
    print_result(as_json, numbers, _rows(found, numbers), str(images[0].parent))


def _rows(found: MultiViewReconstruction, numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Make the table of the terminal."""
    cameras = list(numbers["cameras"].values())
    focal = sorted({(camera["focal_px"][0], camera["intrinsics"]) for camera in cameras})
    shown = ", ".join(f"{px:g} px ({source})" for px, source in focal[:3])
    rows = [
        ("images", f"{numbers['registered']} of {numbers['images']}"),
        *unregistered_rows(numbers["unregistered"], numbers["components"]),
        ("focal length", shown + (", ..." if len(focal) > 3 else "")),
        ("keypoints", f"{numbers['keypoints']:,}"),
        ("pairs", _pairs(numbers)),
        (
            "sparse points",
            f"{numbers['sparse_points']:,}, reprojection error "
            f"{numbers['mean_sparse_reprojection_error_px']:.3f} px (mean)",
        ),
    ]
    if numbers["dense_points"]:
        error = numbers["median_dense_reprojection_error_px"]
        rows.append(
            (
                "dense points",
                f"{numbers['dense_points']:,}, reprojection error {error:.3f} px (median)",
            )
        )
    rows += [("scale", numbers["scale"]), *seconds_rows(numbers["seconds"])]
    rows.append(("written", ", ".join(numbers["files"])))
    return rows


def unregistered_rows(
    unregistered: Mapping[str, str], components: Sequence[Sequence[str]]
) -> list[tuple[str, str]]:
    """Name components that are no part of the model, and the other images one by one.

    Args:
        unregistered: reasons by name.
        components: names of those that hang together among themselves.

    Returns:
        Rows for the table of the terminal.
    """
    rows: list[tuple[str, str]] = []
    grouped: set[str] = set()
    for group in components:
        grouped |= set(group)
        rows.append(
            (
                f"unregistered: {len(group)} images",
                f"{group[0]} and {len(group) - 1} more hang together, but not with the others: "
                "they show something else, or too little of the same; model.json lists them",
            )
        )
    alone = [(name, why) for name, why in unregistered.items() if name not in grouped]
    rows += [(f"unregistered: {name}", why) for name, why in alone[:MAX_UNREGISTERED_ROWS]]
    if len(alone) > MAX_UNREGISTERED_ROWS:
        rows.append(
            ("unregistered", f"{len(alone) - MAX_UNREGISTERED_ROWS} more, listed in model.json")
        )
    return rows


def _pairs(numbers: dict[str, Any]) -> str:
    """Say how many pairs were matched, of how many, and how they were chosen."""
    count = numbers["images"]
    choice = {
        "all": "all of them",
        "sequential": "neighbours by name",
        "similar": f"the most similar of {count * (count - 1) // 2:,}",
    }[numbers["pair_choice"]]
    return f"{numbers['verified_pairs']:,} verified of {numbers['pairs']:,} ({choice})"
