"""`deepdetect export`: files for other programs, with one command per format."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, Parameter

from .._shared.errors import MissingFileError, OptionError
from .._shared.records import Outputs
from ..detector.onnx_files.export import OnnxOptions, write_onnx
from ..detector.point_detector import PointDetector
from ..detector.pretrained import resolve_weights
from ..geometry.camera import Camera
from ..interchange import (
    Collection,
    describe_collection,
    match_folder,
    read_collection,
    write_colmap,
    write_colmap_text,
    write_hloc,
)
from ..interchange.collection import check_names, check_upright
from ..io.image import find_images
from ..sfm.colmap import import_pycolmap, initial_intrinsics, known_cameras
from ..sfm.pipeline import reconstruct_many
from . import _options as cli
from .reconstruct import MANY, POSE

export = App("export", help="Write files for other programs.")

SAVED = cli.From(
    read_collection,
    "matches images",
    more="",
    types={"matches": Path | None, "images": Path | None},
)
FOLDER = cli.From(match_folder, "pairs", more="workers", types={"pairs": str | None})
MAX_KEYPOINTS = cli.From(PointDetector, "max_keypoints", more="")
VERIFY = cli.From(write_colmap, "verify", more="")
CAMERAS = replace(
    POSE, target=reconstruct_many, more="", defaults={"focal_px": "from EXIF, or a guess"}
)
SHARED_CAMERA = replace(MANY, more="single_camera")
ONNX = cli.From(
    OnnxOptions,
    "size",
    types={"size": str | None, "descriptor": str | None},
    defaults={"size": "any; give one such as 480x640 to fix it"},
)
Sources = Annotated[
    Path,
    Parameter(
        required=True,
        help="Features file of `deepdetect extract` (with --matches), npz files of `detect` and "
        "`match` (with --images), or a folder of images, which are then detected and matched.",
    ),
]


@export.command
@cli.command(SAVED, FOLDER, MAX_KEYPOINTS, VERIFY, CAMERAS, SHARED_CAMERA, cli.READING)
def colmap(
    *sources: Sources,
    output: cli.Output = Path("database.db"),
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Write keypoints, descriptors and matches as a COLMAP 4 database.

    If -o is a folder, writes text files for colmap feature_importer and matches_importer instead.

        deepdetect export colmap photos/ -o database.db
        deepdetect export colmap features.h5 --matches matches.h5 --images photos/ -o database.db
        deepdetect export colmap out/*.npz --images photos/ -o database.db
        colmap mapper --database_path database.db --image_path photos/ --output_path sparse/

    Args:
        output: Database (.db), or a folder for text files.
    """
    cameras = CAMERAS.take(values) | SHARED_CAMERA.take(values)
    verify = VERIFY.take(values)
    if output.suffix.lower() != ".db":
        if output.suffix:
            raise OptionError(f"{output} must end in .db, or be the name of a folder")
        for name in cameras:
            raise OptionError(f"text files hold no cameras: leave out `{name}`, or write a .db")
        marker = _new_folder(output, "matches.txt", overwrite)
        return _export(write_colmap_text, sources, output, marker, overwrite, values)
    import_pycolmap("a database of COLMAP")  # if pycolmap is missing, fails early
    calibration, focal_px = cameras.get("calibration"), cameras.get("focal_px")
    if calibration is not None and focal_px is not None:
        raise OptionError("give --calibration or --focal, not both")
    if focal_px is not None:
        Camera((1, 1), focal_px)
    if calibration is not None and not calibration.is_file():
        raise MissingFileError(f"there is no file {calibration}: check the path")

    def write(collection: Collection, path: Path) -> tuple[Path, ...]:
        sizes = {name: points.image_size for name, points in collection.keypoints.items()}
        known = {} if calibration is None else known_cameras(calibration, sizes)
        for name in sorted(sizes.keys() - known.keys()) if known else ():
            raise OptionError(f"{name} and the calibration differ in size: leave --calibration out")
        folder = collection.folder or Path("no-such-folder")
        shared = cameras.get("single_camera")
        intrinsics = initial_intrinsics(folder, sizes, known, focal_px, shared)
        return write_colmap(collection, path, intrinsics=intrinsics, **verify)

    return _export(write, sources, output, output, overwrite, values, describe=False)


@export.command
@cli.command(SAVED, FOLDER, MAX_KEYPOINTS, cli.READING)
def hloc(
    *sources: Sources,
    output: cli.Output = Path("hloc-files"),
    descriptors: bool = True,
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Write features.h5, matches.h5 and pairs.txt, the input files of hloc.reconstruction.main.

        deepdetect export hloc photos/ -o hloc/
        deepdetect export hloc out/*.npz --images photos/ -o hloc/

    Args:
        output: Folder for the files.
        descriptors: Describe keypoints that have no descriptors (needs --images).
    """
    marker = _new_folder(cli.output_folder(output), "features.h5", overwrite)
    if sources[0].is_dir():
        check_upright(find_images(sources[0]))
    return _export(write_hloc, sources, output, marker, overwrite, values, describe=descriptors)


def _new_folder(folder: Path, marker: str, overwrite: bool) -> Path:
    """Return `folder / marker`; raise an OptionError if the folder has only other files."""
    known = overwrite or (folder / marker).exists() or not folder.is_dir()
    if not known and any(not path.name.startswith(".") for path in folder.iterdir()):
        raise OptionError(f"{folder} is not empty: choose another folder with -o, or --overwrite")
    return folder / marker


def _export(
    write: Callable[[Collection, Path], tuple[Path, ...]],
    sources: Sequence[Path],
    output: Path,
    marker: Path,
    overwrite: bool,
    values: dict[str, Any],
    describe: bool = True,
) -> cli.Result:
    """Read a collection, or compute it from a folder of images, and write it to `output`.

    The record of the file `marker` names the inputs of all output files.
    """
    named = [Path(values[name]) for name in ("matches", "pairs") if name in values]
    inputs = [*sources, *(path for path in named if path.exists())]
    cli.check_outputs([marker], inputs)
    of_folder = len(sources) == 1 and sources[0].is_dir()
    if sources[0].is_file() and sources[0].suffix.lower() not in (".npz", ".h5", ".hdf5"):
        find_images(sources[0])  # raises an error with advice
    saved, points = SAVED.take(values), MAX_KEYPOINTS.take(values)
    for name in saved if of_folder else (*points, *values):
        what = "saved files" if of_folder else "a folder of images"
        raise OptionError(f"`{name}` is for {what}: leave it out")
    if of_folder:
        paths = find_images(sources[0])
        if marker != output:
            check_names(path.relative_to(sources[0]).as_posix() for path in paths)
    with cli.claimed(Outputs([marker], inputs, {"command": marker.name}, overwrite=overwrite)):
        if of_folder:
            collection = match_folder(sources[0], PointDetector(**points), quiet=False, **values)
        else:
            collection = read_collection(sources, **saved)
        if describe:
            collection = describe_collection(collection, quiet=False)
        files = write(collection, output)
    failures = collection.failures
    numbers = {
        "images": len(collection.keypoints),
        "keypoints": sum(len(points) for points in collection.keypoints.values()),
        "pairs": len(collection.matches),
        "matches": sum(len(found) for found in collection.matches.values()),
        "files": files,
        "failures": failures,
    }
    return cli.Result(numbers, failures=failures, what="images and pairs")


def size_of(text: str) -> tuple[int, int]:
    """Parse height and width from a text such as 480x640."""
    match = re.fullmatch(r"(\d{1,6})[xX](\d{1,6})", text)
    if match is None:
        raise OptionError(f"{text!r} is not a size: give height and width, such as 480x640")
    return int(match[1]), int(match[2])


@export.command
@cli.command(ONNX)
def onnx(
    weights: str = "default",
    /,
    *,
    output: cli.Output,
    licence: str | None = None,
    **values: Any,
) -> cli.Result:
    """Write weights as an ONNX file, for ONNX Runtime, OpenVINO, OpenCV and others.

    WEIGHTS are default, dense, free, espnet, an ONNX file that this command wrote without --size,
    or a .safetensors file, which needs torch. The input `image` is RGB from 0 to 1. The outputs are
    `probability` and `logits` of each pixel, and the points of --detector points: `keypoints`,
    `scores`, `sizes`, `angles`, and perhaps their `descriptors`. docs/other-programs.md says which
    file suits which runtime.

        deepdetect export onnx -o deepdetect.onnx
        deepdetect export onnx dense -o dense-480x640.onnx --size 480x640 --max-keypoints 0
        deepdetect export onnx run/best.safetensors -o own.onnx
        deepdetect export onnx -o maps.onnx --max-keypoints 0
        deepdetect export onnx -o points.onnx --no-maps --descriptor learned

    Args:
        weights: Name or file of the weights.
        output: The .onnx file, or a folder for deepdetect.onnx.
        licence: Licence of the weights, to be stated in the file.
    """
    file = cli.output_file(output, "deepdetect.onnx")
    if "size" in values:
        values["size"] = size_of(values["size"])
    options = OnnxOptions(**values)
    cli.check_outputs([file], [resolve_weights(weights)])
    metadata = write_onnx(weights, file, options, licence=licence)
    return cli.Result({"file": file, "bytes": file.stat().st_size, "metadata": metadata})
