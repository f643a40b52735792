"""`deepdetect reconstruct` and `pose`: 3D points and camera poses from images."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

from .._shared.errors import OptionError
from .._shared.progress import stage_progress
from .._shared.records import Outputs
from ..io.image import load_image
from ..io.point_cloud import find_writer
from ..reconstruction.pipeline import estimate_pose
from ..reconstruction.pipeline import reconstruct as reconstruct_pair
from ..reconstruction.result import ENDINGS, save_reconstruction
from ..sfm.colmap import import_pycolmap
from ..sfm.formats import check_formats
from ..sfm.pipeline import MAX_KEYPOINTS, check_output_folder, output_files, reconstruct_many
from ..sfm.stages import MultiViewOptions, check_images
from . import _options as cli
from ._detection import DESCRIBED_POINTS, NETWORK, SELECTION, Detector, Kind, chosen_detector

CAMERAS = cli.From(
    reconstruct_pair,
    "calibration focal_px rectified",
    more="",
    flags={"focal_px": "--focal", "rectified": "--rectified/--not-rectified"},
    types={"calibration": Path | None},
    defaults={"focal_px": "from EXIF", "rectified": "detected"},
)
POSE = replace(CAMERAS, target=estimate_pose, common="calibration focal_px", more="seed")
MANY = cli.From(
    MultiViewOptions,
    flags={
        "stride_px": "--stride",
        "single_camera": "--single-camera/--camera-each",
        "control_points": "--gcp",
        "formats": "--format",
    },
    types={"control_points": Path | None},
)
WORKERS = cli.From(reconstruct_many, more="workers")
"""Options that, like those of `MANY`, only a reconstruction from more than two images accepts."""

CHOSEN = replace(
    SELECTION,
    defaults={"max_keypoints": f"{MAX_KEYPOINTS} (two images: 2048); with --detector network all"},
)
DETECTOR = replace(
    NETWORK,
    defaults={
        "weights": "default; for two images dense",
        "threads": "1; for two images the backend's choice",
    },
)

MAX_UNREGISTERED = 4
"""The terminal lists at most this many unregistered images. Chosen by hand."""


@cli.command(CAMERAS, CHOSEN, MANY, WORKERS, DESCRIBED_POINTS, DETECTOR, cli.READING)
def reconstruct(
    *images: cli.Images,
    output: cli.Output = Path("deepdetect-output"),
    detector: Detector | None = None,
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Reconstruct coloured 3D points from two images, from more images, or from a folder.

    Two images, left and right: writes model.ply and model.glb (the points), model.html (an offline
    viewer), model_depth.jpg (a coloured depth map), model_depth.png (16 bits, with its scale),
    model_depth.npz (depths as floats, and the disparities of a rectified pair), and model.json
    (counts, times and quality). For rectified pairs the detector only chooses which pixels of a
    dense disparity map become points; --density 1 takes all of them.

    A folder, or three or more images: also estimates the cameras. Writes model.ply, model.glb,
    model.html (with the cameras), model.json, transforms.json, and COLMAP's sparse/0 and
    database.db. If the images have GPS positions, the model is in metres east, north and up. Run
    the same command again to resume after an interruption. Images that cannot be read, or show
    something else, are left out and listed.

        deepdetect reconstruct left.png right.png --calibration calib.json -o model.ply
        deepdetect reconstruct left.jpg right.jpg --focal 1250
        deepdetect reconstruct phone1.jpg phone2.jpg -o phone/
        deepdetect reconstruct photos/ -o model/
        deepdetect reconstruct frames/ --pairs sequential:8 -o model/
        deepdetect reconstruct drone/ --gcp gcp_list.txt --format laz --format map -o model/
        deepdetect reconstruct photos/ --scale-by 0.25 a.jpg:812,640 a.jpg:1290,655 -o model/

    Args:
        output: Folder for all files. For two images it may also be the name of the model (.ply,
            .glb or .html); the other files are then named after it.
        detector: 'network' selects pixels of the network's heat map; 'points' ranks points of all
            scales and takes the best.  [default: network; for more than two images points]
    """
    folders = [path for path in images if path.is_dir()]
    if folders and len(images) > 1:
        raise OptionError("give either one folder or only image files")
    if len(images) == 1 and not folders:
        load_image(images[0])  # raises an error with advice if it is a video
        raise OptionError("give two or more images, or a folder")
    if len(images) > 2 or folders:
        folder = output / "model" if output == Path("deepdetect-output") else output
        return _reconstruct_many(images, folder, detector or "points", overwrite, values)
    for name in (*MANY.take(values), *WORKERS.take(values)):
        raise OptionError(f"`{name}` is for more than two images")
    model = cli.output_file(output, "model.ply")
    find_writer(model)
    files = {ending: model.with_name(model.stem + ending) for ending in ENDINGS}
    files[model.suffix.lower()] = model
    if "calibration" in values:
        cli.check_outputs(files.values(), [values["calibration"]])
    chosen, selection = chosen_detector(
        detector or "network", values, options=DESCRIBED_POINTS, weights="dense"
    )
    with cli.writing(files, images, overwrite) as made, stage_progress("reconstructing") as done:
        left, right = images
        found = reconstruct_pair(left, right, chosen, selection=selection, progress=done, **values)
        title = f"{left.name} and {right.name}"
        named = {"left": left, "right": right, "files": [*files.values()]}
        numbers = save_reconstruction(found, made, title, **named)
    low, high = (f"{numbers['depth'][percent]:,.4g}" for percent in ("5%", "95%"))
    unit = "mm" if found.unit == "mm" else f"{found.unit}s"
    sentence = f"{len(found):,} 3D points, most of them {low} to {high} {unit} away"
    shown = {**numbers, "look_at": [files[".html"], files["_depth.jpg"]], "model": model}
    names = "scale rectified_why seconds model look_at"
    return cli.Result(numbers, cli.headed(sentence, shown, names))


@cli.command(POSE, NETWORK, cli.READING)
def pose(first: Path, second: Path, /, **values: Any) -> cli.Result:
    """Estimate the pose of the second camera relative to the first, from one image of each.

    A point X in the first camera's frame (x right, y down, z forward) is R X + t in the second's.
    The scale of t is unknown. Ends with exit code 3 if the images do not determine the pose: they
    show one plane, or the camera only rotated.

        deepdetect pose left.jpg right.jpg --focal 1250
        deepdetect pose left.jpg right.jpg --calibration calib.json --json

    Args:
        first: Image of the first camera.
        second: Image of the second camera.
    """
    chosen, _ = chosen_detector("network", values)
    with stage_progress("pose") as done:
        found = estimate_pose(first, second, chosen, progress=done, **values)
    numbers = {
        "R": found.rotation.tolist(),
        "t": found.translation.tolist(),
        "angle_deg": found.angle,
        "matches": len(found.inliers),
        "inliers": int(found.inliers.sum()),
        "left_out": round(found.left_out, 4),
    }
    rows = {f"R, row {k}": row for k, row in enumerate(numbers["R"], 1)}
    agree = f"{numbers['inliers']:,} of {numbers['matches']:,} matches agree"
    sentence = f"the second camera is rotated by {found.angle:.2f} degrees; {agree}"
    return cli.Result(numbers, cli.table({**rows, "t": numbers["t"]}, title=sentence))


def _reconstruct_many(
    images: Sequence[Path], output: Path, kind: Kind, overwrite: bool, values: dict[str, Any]
) -> cli.Result:
    if "rectified" in values:
        raise OptionError("--rectified and --not-rectified are for two images")
    detector, selection = chosen_detector(
        kind, values, max_keypoints=MAX_KEYPOINTS, options=DESCRIBED_POINTS, threads=1
    )
    source: Path | Sequence[Path] = images[0] if len(images) == 1 else images
    many = MANY.take(values)
    # Missing packages and wrong options raise errors before anything is written.
    import_pycolmap()
    check_formats(many.get("formats", ()))
    check_output_folder(output)
    check_images(source)
    values |= {"selection": selection, "options": MultiViewOptions(**many), "overwrite": overwrite}
    files = output_files(output, many.get("formats", ()))
    with Outputs(files, sorted(images), overwrite=overwrite, growing=True).writing():
        reconstruct_many(source, output, detector, quiet=False, **values)
    numbers = json.loads((output / "model.json").read_text(encoding="utf-8"))
    few = dict(islice(numbers["unregistered"].items(), MAX_UNREGISTERED))
    place = numbers.get("georeference", {})
    shown = {**place, **numbers, "unregistered": few, "wrong_positions": place.get("wrong")}
    shown["look_at"] = output / "model.html"
    points = f"{numbers['sparse_points']:,} sparse and {numbers['dense_points']:,} dense 3D points"
    sentence = f"{numbers['registered']} of {numbers['images']} images registered, {points}"
    names = "unregistered scale note wrong_positions median_residual_across_m seconds look_at"
    return cli.Result(numbers, cli.headed(sentence, shown, names))
