"""`deepdetect reconstruct`: two photographs, or a folder of them, to a 3D point cloud."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._generated import FieldOptions, generated_command, given_only
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
    overwrite_option,
    print_result,
    processes_option,
    seconds_rows,
)
from ._reconstruct_many import MANY, OUTPUT, reconstruct_folder

if TYPE_CHECKING:
    from ..reconstruction.result import Reconstruction

CAMERAS = FieldOptions(
    "reconstruction.pipeline:reconstruct",
    names=("calibration", "focal_px", "rectified"),
    flags={"focal_px": "--focal", "rectified": "--rectified/--not-rectified"},
    metavars={"focal_px": "PX"},
    defaults={"focal_px": "from EXIF", "rectified": "detected"},
    types={"calibration": PATH},
)
WHOLE_PIXEL_SELECTION = dataclasses.replace(SELECTION, skip=("subpixel",))
DENSE_DETECTOR = dataclasses.replace(
    DETECTOR, defaults={**DETECTOR.defaults, "weights": "dense, of more than two: default"}
)

MODEL = Path("deepdetect-output/model.ply")

STAGES = 8
"""Of a reconstruction at most; the files are one more."""


@generated_command(
    CAMERAS,
    WHOLE_PIXEL_SELECTION,
    POINTS,
    DENSE_DETECTOR,
    MANY,
    short_help="A 3D reconstruction of two photographs, or of many.",
)
@click.argument("images", type=PATH, nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    type=PATH,
    help="Of two photographs the model, .ply, .glb or .html; the other files get its name and "
    f"stand beside it. Of more the folder for all files.  [default: {MODEL}; {OUTPUT}]",
)
@detector_option("network, of more than two images points")
@max_megapixels_option
@processes_option
@overwrite_option
@json_option
def reconstruct(
    images: tuple[Path, ...],
    output: Path | None,
    kind: str | None,
    workers: int | None,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Reconstruct a cloud of coloured 3D points from IMAGES: two, or a folder or more of them.

    Two photographs, left and right: writes STEM.ply and STEM.glb (the points), STEM.html (an
    offline viewer), STEM_depth.jpg (a coloured depth map to look at), STEM_depth.png (16 bits, with
    its scale), STEM_depth.npz (floats; disparities too for rectified pairs), and STEM.json (counts,
    times and quality).

    For rectified pairs the detector only chooses which pixels of a dense disparity map become
    points; --density 1 takes all of them.

    A folder, or three and more photographs: their cameras are estimated, too. Writes model.ply,
    model.glb, model.html (with the cameras), model.json, and COLMAP's sparse/ and database.db into
    a folder. When it is interrupted or killed, the same command goes on. Photographs that cannot be
    read, or show something else, are left out, and listed.

    \b
    deepdetect reconstruct left.png right.png --calibration calib.json -o model.ply
    deepdetect reconstruct left.jpg right.jpg --focal 1250 -o model.ply
    deepdetect reconstruct phone1.jpg phone2.jpg
    deepdetect reconstruct photos/ -o model/
    deepdetect reconstruct frames/ --sequential 8 -o model/
    """
    folders = [path for path in images if path.is_dir()]
    if len(images) > 2 or folders:
        if folders and len(images) > 1:
            raise click.UsageError("give one folder, or photographs: not both")
        reconstruct_folder(images, output, kind or "points", workers, overwrite, as_json, values)
        return
    if len(images) < 2:
        raise click.UsageError("give two photographs, or more, or a folder of them")
    of_many = {name: values.pop(name) for name in MANY.names}
    for name in given_only({**of_many, "workers": workers}):
        flag = MANY.flags.get(name, "--" + name.replace("_", "-"))
        raise click.UsageError(f"{flag} is for more than two photographs")
    values["kind"] = kind or "network"
    _reconstruct_two(images[0], images[1], output or MODEL, overwrite, as_json, **values)


def _reconstruct_two(
    left: Path,
    right: Path,
    output: Path,
    overwrite: bool,
    as_json: bool,
    calibration: Path | None,
    kind: str,
    **values: Any,
) -> None:
    """Reconstruct two photographs, and print what was found."""
    from .._shared.progress import progress
    from ..io.point_cloud import find_writer
    from ..reconstruction.pipeline import reconstruct as reconstruct_pair
    from ._records import check_outputs, claimed_outputs

    find_writer(output)
    files = _files(output, [path for path in (left, right, calibration) if path is not None])
    detector, selection = chosen_detector(kind, values, weights="dense")
    check_outputs("reconstruct", [left, right], list(files.values()), overwrite)
    chosen = given_only(values)
    # On a terminal only: what is logged stays readable.
    with progress(STAGES + 1, "reconstructing", "stage", not sys.stderr.isatty()) as bar:

        def done(stage: str) -> None:
            bar.set_postfix_str(stage)
            bar.update()

        found = reconstruct_pair(
            left,
            right,
            detector,
            calibration=calibration,
            selection=selection,
            progress=done,
            **chosen,
        )
        bar.update(STAGES - bar.n)
        with claimed_outputs("reconstruct", [left, right], list(files.values()), overwrite):
            numbers = _write(found, files, {"left": left, "right": right})
        done("files")
    print_result(as_json, numbers, _rows(found, numbers), f"{left} and {right}")


def _files(model: Path, inputs: list[Path]) -> dict[str, Path]:
    """Name all files, and check that none of them is an input."""
    from ..io.point_cloud import POINT_CLOUD_WRITERS

    endings = (*POINT_CLOUD_WRITERS, "_depth.png", "_depth.npz", "_depth.jpg", ".json")
    files = {ending: model.with_name(model.stem + ending) for ending in endings}
    files[model.suffix.lower()] = model
    check_inputs_survive(files.values(), inputs, "give the model another name by -o")
    return files


def _write(
    found: Reconstruction, files: dict[str, Path], images: dict[str, Path]
) -> dict[str, Any]:
    """Write all files, the JSON last; return what it holds."""
    import json

    from .._shared.atomic import atomic_path
    from ..io.depth import save_depth_npz, save_depth_png
    from ..io.point_cloud import POINT_CLOUD_WRITERS, save_point_cloud
    from ..viz.draw import draw_depth, save_picture

    started = time.perf_counter()
    values = found.summary()
    notes = {
        "title": f"{images['left'].name} and {images['right'].name}",
        "pair": "rectified" if found.rectified else "not rectified",
        "calibration": found.calibration.source,
        "scale": values["scale"],
    }
    for ending in POINT_CLOUD_WRITERS:
        save_point_cloud(found.cloud, files[ending], notes)
    depth = found.depth_map()
    stored = save_depth_png(depth, files["_depth.png"], found.unit)
    arrays = {} if found.disparity is None else {"disparity": found.disparity_map()}
    save_depth_npz(depth, files["_depth.npz"], found.unit, matched=found.matched_map(), **arrays)
    save_picture(draw_depth(depth, found.unit), files["_depth.jpg"])
    values["seconds"]["files"] = round(time.perf_counter() - started, 4)
    numbers = {
        **images,
        **values,
        "depth_png": stored,
        "files": list(files.values()),
    }
    with atomic_path(files[".json"]) as temporary:
        temporary.write_text(json.dumps(numbers, indent=2, default=str) + "\n", encoding="utf-8")
    return numbers


def _rows(found: Reconstruction, numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Make the table of the terminal."""
    unit = {"mm": "mm", "baseline": "baselines"}[found.unit]
    depth, source = numbers["depth"], found.calibration.source
    angle = numbers["median_triangulation_angle_degrees"]
    filled = f", {numbers['filled']:,} of them filled in" if numbers["filled"] else ""
    rows = [
        ("rectified", f"{'yes' if found.rectified else 'no'} ({numbers['rectified_why']})"),
        ("focal length", f"{numbers['calibration']['left']['focal_px'][0]:g} px ({source})"),
        ("keypoints", f"{found.keypoints:,}"),
        ("matches", f"{found.matches:,}"),
        *((f"dropped: {reason}", f"{count:,}") for reason, count in found.dropped.items()),
        ("points", f"{len(found):,} ({numbers['density']:.1%} of the pixels{filled})"),
        ("depth", f"{depth['5%']:.4g} to {depth['95%']:.4g} {unit}, median {depth['50%']:.4g}"),
        ("scale", numbers["scale"]),
        ("triangulation angle", f"{angle:.2f} degrees (median)"),
    ]
    if found.reprojection_errors is not None:
        error = numbers["median_reprojection_error_px"]
        rows.append(("reprojection error", f"{error:.3f} px (median)"))
    per_unit = numbers["depth_png"]["value_per_unit"]
    rows += seconds_rows(numbers["seconds"])
    rows.append(("depth PNG", f"value / {per_unit:g} = depth in {unit}; 0 is unknown"))
    rows.append(("written", ", ".join(str(path) for path in numbers["files"])))
    return rows
