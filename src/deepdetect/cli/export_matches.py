"""`deepdetect export colmap` and `hloc`: keypoints and matches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._shared.errors import BatchError, MissingFileError, OptionError
from ._options import (
    PATH,
    check_inputs_survive,
    json_option,
    max_megapixels_option,
    overwrite_option,
    print_result,
    processes_option,
)
from ._records import claimed_outputs

if TYPE_CHECKING:
    from ..interchange import Collection
    from ..sfm.intrinsics import CameraIntrinsics

Command = Callable[..., Any]

_COMMON: tuple[Callable[[Command], Command], ...] = (
    click.argument("sources", type=PATH, nargs=-1, required=True, metavar="SOURCE..."),
    click.option(
        "--matches", type=PATH, help="File of deepdetect match-many, with a file of features."
    ),
    click.option(
        "--images",
        type=PATH,
        metavar="FOLDER",
        help="Folder of the photographs: completes names of npz files; descriptors, where the "
        "files have none, and EXIF come from it.",
    ),
    click.option(
        "--pairs", type=PATH, help="Text file of the pairs to be matched, of a folder as SOURCE."
    ),
    click.option(
        "--sequential",
        type=click.IntRange(min=1),
        help="Match each photograph of the folder with that many next ones by name.",
    ),
    click.option(
        "--max-keypoints",
        type=click.IntRange(min=1),
        help="Of each photograph of the folder.  [default: 2048]",
    ),
    processes_option,
    max_megapixels_option,
    overwrite_option,
    json_option,
)

_CAMERAS: tuple[Callable[[Command], Command], ...] = (
    click.option(
        "--calibration",
        type=PATH,
        metavar="FILE",
        help="JSON file of the camera (docs/reconstruction.md), taken to be exact.",
    ),
    click.option(
        "--focal",
        "focal_px",
        type=float,
        help="Focal length in pixels, roughly.  [default: of EXIF, or a guess]",
    ),
    click.option(
        "--single-camera/--camera-each",
        default=None,
        help="Whether photographs of one size share a camera.  [default: where the focal lengths "
        "are equal]",
    ),
)

CAMERA_FLAGS = {
    "calibration": "--calibration",
    "focal_px": "--focal",
    "single_camera": "--single-camera",
}


def _with(*options: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Add options to a command, in this order."""

    def decorate(function: Command) -> Command:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


def _folder_output(default: str) -> Callable[[Command], Command]:
    return click.option(
        "-o",
        "--output",
        type=PATH,
        default=Path(default),
        show_default=True,
        help="Folder for the files.",
    )


@click.command("colmap", short_help="Keypoints and matches as a database of COLMAP.")
@_with(*_COMMON, *_CAMERAS)
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("database.db"),
    show_default=True,
    help="Database (.db), or a folder for text files.",
)
@click.option(
    "--verify/--no-verify",
    default=True,
    show_default=True,
    help="Estimate two-view geometries, which COLMAP's mapper needs.",
)
def export_colmap(sources: tuple[Path, ...], output: Path, verify: bool, **values: Any) -> None:
    """Write keypoints, descriptors and matches as a database of COLMAP 4.

    SOURCE is features.h5 of deepdetect extract (with --matches matches.h5), or npz files of the
    commands detect and match, or a folder of photographs, which are matched first. With a folder
    as -o, the text files of colmap feature_importer and matches_importer are written.

    \b
    deepdetect export colmap photos/ -o database.db
    deepdetect export colmap features.h5 --matches matches.h5 --images photos/ -o database.db
    deepdetect export colmap out/*.npz --images photos/ -o database.db
    colmap mapper --database_path database.db --image_path photos/ --output_path sparse/
    """
    if output.suffix.lower() != ".db":
        if output.suffix:
            raise OptionError(f"{output} must end in .db, or be the name of a folder")
        for name, flag in CAMERA_FLAGS.items():
            if values.pop(name) is not None:
                raise OptionError(f"text files hold no cameras: leave out {flag}, or write a .db")
        _export("colmap-text", sources, output, True, values)
        return
    _export("colmap", sources, output, None, values, verify=verify)


@click.command("hloc", short_help="Keypoints and matches as files of hloc.")
@_with(*_COMMON)
@_folder_output("hloc-files")
@click.option(
    "--descriptors/--no-descriptors",
    default=True,
    show_default=True,
    help="Describe keypoints that have no descriptors (needs --images).",
)
def export_hloc(sources: tuple[Path, ...], output: Path, descriptors: bool, **values: Any) -> None:
    """Write features.h5, matches.h5 and pairs.txt, the arguments of hloc.reconstruction.main.

    SOURCE as of deepdetect export colmap. Numbers are float32 and int32.

    \b
    deepdetect export hloc photos/ -o hloc/
    deepdetect export hloc out/*.npz --images photos/ -o hloc/
    """
    _export("hloc", sources, output, descriptors, values)


def _export(
    form: str,
    sources: tuple[Path, ...],
    output: Path,
    describe: bool | None,
    values: dict[str, Any],
    **settings: Any,
) -> None:
    """Read or make a collection, and write it.

    Args:
        form: name of the format.
        sources: files, or a folder of photographs.
        output: file or folder.
        describe: whether keypoints without descriptors are described; None: points with sizes.
        values: of the options that several commands share.
        settings: of the format.
    """
    from ..interchange import describe_collection, write_colmap, write_colmap_text, write_hloc
    from ..sfm.colmap import import_pycolmap

    as_json, overwrite = values.pop("as_json"), values.pop("overwrite")
    camera = {name: values.pop(name) for name in CAMERA_FLAGS if name in values}
    inputs = [*sources, *(path for path in (values["matches"], values["pairs"]) if path)]
    one_file = form == "colmap"
    if one_file:  # what is missing is said before the work
        import_pycolmap("a database of COLMAP")
    _check_before_work(form, sources, camera)
    marker = output if one_file else output / MARKERS[form]
    if not (one_file or overwrite or marker.exists()) and _has_files(output):
        raise OptionError(
            f"{output} is a folder that is not empty: choose another with -o, or write into it "
            "with --overwrite"
        )
    check_inputs_survive([marker], inputs, "choose another name with -o")
    with claimed_outputs(f"export-{form}", inputs, [marker], overwrite):
        collection = _collection(sources, values)
        if describe:
            collection = describe_collection(collection, quiet=False)
        if camera:
            settings["intrinsics"] = _intrinsics(collection, camera)
        writers: dict[str, Callable[..., tuple[Path, ...]]] = {
            "colmap": write_colmap,
            "colmap-text": write_colmap_text,
            "hloc": write_hloc,
        }
        files = writers[form](collection, output, **settings)
    keypoints = sum(len(points) for points in collection.keypoints.values())
    matches = sum(len(found) for found in collection.matches.values())
    print_result(
        as_json,
        {
            "format": form,
            "images": len(collection.keypoints),
            "keypoints": keypoints,
            "pairs": len(collection.matches),
            "matches": matches,
            "files": files,
            "failures": collection.failures,
        },
        [
            ("images", f"{len(collection.keypoints):,} with {keypoints:,} keypoints"),
            ("pairs", f"{len(collection.matches):,} with {matches:,} matches"),
            ("written", str(output) if len(files) == 1 else f"{len(files)} files in {output}"),
        ],
    )
    if count := len(collection.failures):
        raise BatchError(
            f"{count} of the photographs and pairs failed, the others are in {output}",
            collection.failures,
        )


def _check_before_work(form: str, sources: tuple[Path, ...], camera: Mapping[str, Any]) -> None:
    """Say what is wrong with cameras and names before photographs are matched."""
    from ..geometry.camera import Camera
    from ..interchange.collection import check_names, check_upright
    from ..io.image import find_images
    from ._records import check_not_made

    calibration, focal_px = camera.get("calibration"), camera.get("focal_px")
    if calibration is not None and focal_px is not None:
        raise OptionError("give --calibration or --focal, not both")
    if focal_px is not None:
        Camera((1, 1), focal_px)
    if calibration is not None and not calibration.is_file():
        raise MissingFileError(f"there is no file {calibration}: check the path")
    if len(sources) == 1 and sources[0].is_dir():
        paths = find_images(sources[0])
        check_not_made(sources[0], paths)
        if form != "colmap":
            check_names(path.relative_to(sources[0]).as_posix() for path in paths)
        if form == "hloc":
            check_upright(paths)


def _has_files(folder: Path) -> bool:
    """Return whether a folder is there and holds more than hidden files."""
    return folder.is_dir() and any(not path.name.startswith(".") for path in folder.iterdir())


MARKERS = {"colmap-text": "matches.txt", "hloc": "features.h5"}
"""File of a folder by which it is known whose it is."""


def _collection(sources: tuple[Path, ...], values: Mapping[str, Any]) -> Collection:
    """Read saved keypoints and matches, or find and match those of a folder."""
    from ..detector.point_detector import PointDetector
    from ..interchange import match_folder, read_collection

    of_folder = {name: values[name] for name in ("pairs", "sequential", "max_keypoints")}
    if len(sources) == 1 and sources[0].is_dir():
        if values["matches"] is not None or values["images"] is not None:
            raise OptionError(
                f"{sources[0]} is a folder of photographs: leave out --matches and --images"
            )
        count = of_folder.pop("max_keypoints")
        detector = PointDetector() if count is None else PointDetector(count)
        workers = values["workers"]
        return match_folder(sources[0], detector, workers=workers, quiet=False, **of_folder)
    unused = [name for name, value in of_folder.items() if value is not None]
    if unused:
        flag = "--" + unused[0].replace("_", "-")
        raise OptionError(f"{flag} is for a folder of photographs: leave it out")
    return read_collection(sources, matches=values["matches"], images=values["images"])


def _intrinsics(collection: Collection, camera: Mapping[str, Any]) -> dict[str, CameraIntrinsics]:
    """Return the intrinsics of all images."""
    from ..sfm.intrinsics import initial_intrinsics, known_cameras

    sizes = {name: points.image_size for name, points in collection.keypoints.items()}
    calibration = camera["calibration"]
    known = {} if calibration is None else known_cameras(calibration, sizes)
    if calibration is not None and (others := sizes.keys() - known.keys()):
        name = min(others)
        raise OptionError(
            f"{name} is {sizes[name][0]}x{sizes[name][1]} pixels, and the calibration is for "
            "another size: leave the image out"
        )
    folder = collection.folder or Path("no-such-folder")
    focal_px, single_camera = camera["focal_px"], camera["single_camera"]
    return initial_intrinsics(folder, sizes, known, focal_px, single_camera)


EXPORTS_OF_MATCHES = (export_colmap, export_hloc)
