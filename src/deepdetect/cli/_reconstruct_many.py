"""`deepdetect reconstruct` with a folder, or with three or more photographs."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._generated import FieldOptions, given_only
from ._options import chosen_detector, print_result, seconds_rows

if TYPE_CHECKING:
    from ..sfm.result import MultiViewReconstruction

MANY = FieldOptions(
    "sfm.options:MultiViewOptions",
    names=("pairs", "sequential", "dense", "stride_px", "single_camera"),
    flags={
        "stride_px": "--stride",
        "single_camera": "--single-camera/--camera-each",
    },
    metavars={"sequential": "N", "stride_px": "PX"},
)
"""Options that two photographs do not have."""

OUTPUT = Path("deepdetect-output/model")

MAX_UNREGISTERED_ROWS = 10
"""Images that are named with a reason on the terminal; model.json names all."""


def reconstruct_folder(
    images: Sequence[Path],
    output: Path | None,
    kind: str,
    workers: int | None,
    overwrite: bool,
    as_json: bool,
    values: dict[str, Any],
) -> None:
    """Reconstruct many photographs, and print what was found."""
    from ..sfm.colmap import import_pycolmap
    from ..sfm.options import MultiViewOptions
    from ..sfm.pipeline import (
        MAX_KEYPOINTS,
        check_output_folder,
        output_files,
        reconstruct_many,
    )
    from ..sfm.stages import check_images
    from ._records import check_not_made, claim_outputs

    target = OUTPUT if output is None else output
    detector, selection = chosen_detector(kind, values, max_keypoints=MAX_KEYPOINTS, threads=1)
    if values.pop("rectified") is not None:
        raise click.UsageError("--rectified and --not-rectified are for two photographs")
    chosen = given_only({name: values.pop(name) for name in MANY.names})
    if "sequential" in chosen:
        chosen.setdefault("pairs", "sequential")
    photographs: Path | Sequence[Path] = images[0] if len(images) == 1 else images
    # What is missing or wrong is said before anything is written.
    import_pycolmap()
    check_output_folder(target)
    found_images = check_images(photographs)
    if isinstance(photographs, Path):
        check_not_made(photographs, found_images.values())
    claim_outputs("reconstruct", sorted(images), output_files(target), overwrite, growing=True)
    found = reconstruct_many(
        photographs,
        target,
        detector,
        selection=selection,
        workers=workers,
        overwrite=overwrite,
        quiet=False,
        options=MultiViewOptions(**chosen),
        **given_only(values),
    )
    numbers = json.loads((target / "model.json").read_text(encoding="utf-8"))
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
