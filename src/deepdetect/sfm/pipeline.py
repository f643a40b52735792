"""Reconstruct the cameras, sparse points and dense points of many images.

Features and matches come from `batch`, poses from COLMAP. The results of each stage are kept in the
output folder, so the same call continues an interrupted run, even if images have been added.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from .._shared.atomic import atomic_path, write_whole
from .._shared.errors import NoDepthError, OptionError, ReconstructionError
from .._shared.options import suggest_keywords
from .._shared.progress import StageTimer
from ..batch.extraction import noted_range
from ..batch.pair_list import Pair
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.selection import SelectionOptions
from ..geometry.camera import Calibration, Camera, check_camera_file
from ..geometry.point_cloud import EAST_NORTH_UP, PointCloud
from ..io.html_viewer import write_html_page
from ..io.image import one_range
from ..io.image_file import read_with, reading_options
from ..io.point_cloud import save_point_cloud
from .colmap import import_pycolmap, initial_intrinsics, known_cameras
from .control_points import ControlRow, read_control_points
from .formats import FORMATS, FormatName, check_formats
from .fusion import DENSE_POINT
from .georeference import Georeference, georeference, require_fixes, require_images
from .mapping import MIN_VIEWS, read_sparse_model, transform_model
from .result import MultiViewReconstruction
from .splat import write_transforms
from .stages import WORK, MultiViewOptions, Stages, check_images

MIN_KEYPOINTS, MAX_KEYPOINTS = 15, 8192
"""Images with fewer keypoints than `MIN_KEYPOINTS` are left out, because they cannot be matched. By
default, at most `MAX_KEYPOINTS` are detected in an image. Chosen by hand."""


@suggest_keywords
def reconstruct_many(
    images: str | Path | Sequence[str | Path],
    output: str | Path,
    detector: DeepDetect | PointDetector | None = None,
    *,
    selection: SelectionOptions | None = None,
    calibration: Camera | Calibration | str | Path | None = None,
    focal_px: float | None = None,
    seed: int = 0,
    options: MultiViewOptions = MultiViewOptions(),
    workers: int | None = None,
    overwrite: bool = False,
    quiet: bool = True,
) -> MultiViewReconstruction:
    """Reconstruct the cameras and a dense model from three or more images of a scene.

    Writes into the folder `output`: model.ply, model.glb, model.html (a viewer, with the cameras),
    model.json, transforms.json (for nerfstudio), sparse/0 and database.db (for COLMAP), and work/
    with intermediate results. If three images have GPS, the model is in metres east, north and up.
    The same call continues an interrupted run. The function starts processes, so a script must call
    it under `if __name__ == "__main__":`.

    Args:
        images: a folder, or image files.
        output: folder for the results.
        detector: detector of the keypoints; by default a `PointDetector` of 8,192 points.
        selection: which keypoints are kept, as in `extract_features`.
        calibration: known cameras, which are kept fixed: a calibration file, a `Calibration` or a
            `Camera`. By default, focal length and distortion are estimated.
        focal_px: rough focal length of all images in pixels; by default from EXIF, or a guess.
        seed: seed of all random choices; COLMAP's threads may still cause small differences.
        options: options of all stages.
        workers: number of processes; default one per processor.
        overwrite: repeat all stages.
        quiet: show no progress bars.

    Returns:
        Cameras and points. `unregistered` gives the images left out, each with the reason.

    Raises:
        ImageError: the folder is missing or holds no image.
        OptionError: an option is unknown or out of range, or differs from that of an earlier run.
        ReconstructionError: fewer than three images can be used.
        NoDepthError: the images do not overlap enough, or do not determine depth.
        MissingExtraError: pycolmap or h5py is not installed.

    Example:
        >>> if __name__ == "__main__":  # doctest: +SKIP
        ...     found = reconstruct_many("images", "model", quiet=False)
        ...     found.centres, found.dense.points, found.unregistered
    """
    target = Path(output)
    control = _check_arguments(images, target, calibration, focal_px, options)
    detector = PointDetector(MAX_KEYPOINTS) if detector is None else detector
    if overwrite and any((target / WORK).glob("features.h5*")):  # not a folder of another program
        shutil.rmtree(target / WORK, ignore_errors=True)
    stages = Stages(target, options, workers, quiet, seed)
    folder = stages.folder_of(images)
    if control is None and (placed := [n for n in options.formats if FORMATS[n].placed]):
        require_fixes(folder, f"the format {placed[0]}")
    paths = [folder / name for name in check_images(folder)]
    with read_with(reading_options(deep_range=noted_range(stages.features))), one_range(paths):
        return _reconstruct(stages, folder, detector, selection, calibration, focal_px, control)


def _reconstruct(
    stages: Stages,
    folder: Path,
    detector: DeepDetect | PointDetector,
    selection: SelectionOptions | None,
    calibration: Camera | Calibration | str | Path | None,
    focal_px: float | None,
    control: list[ControlRow] | None,
) -> MultiViewReconstruction:
    """Run the stages of `reconstruct_many`, and write all files."""
    target, options = stages.output, stages.options
    timer = StageTimer()
    with timer.stage("features"):
        sizes, keypoints, unregistered = stages.extract(folder, detector, selection)
    sizes, known = _usable_images(sizes, keypoints, calibration, unregistered)
    with timer.stage("matching"):
        matches, alike = stages.match_images(sizes)
    for name, other in alike.items():
        unregistered[name] = f"it shows nearly the same as {other}"
        del sizes[name]
    if alike and len(sizes) < MIN_VIEWS:
        raise NoDepthError(f"all images except {len(sizes)} show nearly the same: move the camera")
    intrinsics = initial_intrinsics(folder, sizes, known, focal_px, options.single_camera)
    with timer.stage("mapping"):
        model, verified, components = stages.map(folder, intrinsics, matches, bool(known))
    sources = {name: own.source for name, own in intrinsics.items()}
    sparse = read_sparse_model(model, sources)
    for name in sizes:
        if name not in sparse.images:
            unregistered[name] = _why_unregistered(name, verified, components)
    with timer.stage("dense points"):
        dense = stages.dense(folder, sparse) if options.dense else np.empty(0, DENSE_POINT)
    with timer.stage("files"):
        reference = min(sparse.views.values(), key=lambda v: float(np.linalg.norm(v.centre))).name
        unit = "spacing", f"camera of {reference}"
        place = georeference(sparse, dense["points"], folder, control, options.scale_by)
        if isinstance(place, Georeference):
            unit = "m", unit[1] if place.origin is None else EAST_NORTH_UP
            transform_model(model, place.similarity)
            sparse = read_sparse_model(model, sources)
            dense["points"] = place.similarity.apply(dense["points"])
            dense["normals"] = dense["normals"] @ place.similarity.rotation.T
        views = dict(sorted(sparse.views.items()))
        left = (tuple(sorted(names & unregistered.keys())) for names in components)
        found = MultiViewReconstruction(
            georeference=place,
            views=views,
            intrinsics={name: sparse.images[name].intrinsics for name in views},
            unregistered=dict(sorted(unregistered.items())),
            components=(*sorted((n for n in left if len(n) > 1), key=len, reverse=True),),
            reference=reference,
            sparse=PointCloud(sparse.points, sparse.colors, *unit),
            sparse_errors=sparse.errors.astype(np.float32),
            sparse_views=sparse.tracks.astype(np.int32),
            dense=PointCloud(
                dense["points"].copy(), dense["colors"].copy(), *unit, dense["normals"].copy()
            ),
            dense_errors=dense["errors"].copy(),
            dense_views=dense["views"].copy(),
            keypoints=keypoints,
            matched=verified,
            pairs=len(matches),
            pair_choice=options.pair_choice(len(sizes)),
            left_out=stages.left_out,
            seconds=timer.seconds,
            files=output_files(target, options.formats)[:-1],
        )
        (target / "sparse" / "0").mkdir(parents=True, exist_ok=True)
        model.write(target / "sparse" / "0")
        _write(found, folder, target, options.formats)
    return found


def _check_arguments(
    images: str | Path | Sequence[str | Path],
    output: Path,
    calibration: Camera | Calibration | str | Path | None,
    focal_px: float | None,
    options: MultiViewOptions,
) -> list[ControlRow] | None:
    """Check the arguments before the long computation; return the ground control points, if any."""
    import_pycolmap()
    check_formats(options.formats)
    control = read_control_points(options.control_points) if options.control_points else None
    check_output_folder(output)
    if focal_px is not None:
        Camera((1, 1), focal_px)  # checks the focal length
        if calibration is not None:
            raise OptionError("give `calibration` or `focal_px`, not both")
    if isinstance(calibration, (str, Path)):
        check_camera_file(calibration)
    if control is not None or options.scale_by is not None:
        require_images(check_images(images, [output]), control, options.scale_by)
    return control


def _usable_images(
    sizes: Mapping[str, tuple[int, int]],
    keypoints: Mapping[str, int],
    calibration: Camera | Calibration | str | Path | None,
    unregistered: dict[str, str],
) -> tuple[dict[str, tuple[int, int]], Mapping[str, Camera]]:
    """Return the sizes and known cameras of usable images; add the others to `unregistered`."""
    for name, count in keypoints.items():
        if count < MIN_KEYPOINTS:
            unregistered[name] = (
                f"it has only {count} keypoints: it is black, blurred, or has no texture"
            )
    sizes = {name: size for name, size in sizes.items() if keypoints[name] >= MIN_KEYPOINTS}
    known: Mapping[str, Camera] = {}
    if calibration is not None:
        known = known_cameras(calibration, sizes)
        for name, (width, height) in sizes.items():
            if name not in known:
                unregistered[name] = (
                    f"it is {width}x{height} pixels, but the calibration is for another size: "
                    "give images of one size"
                )
        sizes = {name: sizes[name] for name in known}
    if len(sizes) < MIN_VIEWS:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in [*unregistered.items()][:3])
        raise ReconstructionError(
            f"{len(sizes)} of {len(sizes) + len(unregistered)} images can be used, but "
            f"{MIN_VIEWS} are needed: {reasons or 'take more images'}"
        )
    return sizes, known


def check_output_folder(output: Path) -> None:
    """Raise an OptionError if `output` is the name of a file instead of a folder."""
    if output.is_file() or output.suffix.lower() in (".ply", ".glb", ".html"):
        raise OptionError(f"{output} is the name of a file: give the name of a folder with -o")


def output_files(output: Path, formats: Sequence[FormatName] = ()) -> tuple[Path, ...]:
    """Return the paths of all results in the output folder. The last one is the folder `WORK`."""
    names = (
        *("model.ply", "model.glb", "model.html", "model.json", "transforms.json"),
        *("sparse", "database.db"),
    )
    more = [file for name in formats for file in FORMATS[name].files]
    return tuple(output / name for name in (*names, *more, WORK))


def _write(
    found: MultiViewReconstruction, folder: Path, output: Path, formats: Sequence[FormatName]
) -> None:
    """Write the files of the model, then each further format, even if another format has failed."""
    notes = {
        "title": f"{len(found.views)} images",
        "images": f"{len(found.views)} of {len(found.views) + len(found.unregistered)}",
        "sparse points": f"{len(found.sparse):,}",
    }
    save_point_cloud(found.cloud, output / "model.ply", notes)
    save_point_cloud(found.cloud, output / "model.glb", notes)
    # The page shows points and cameras in the frame of the reference image's camera.
    view, cloud = found.views[found.reference], found.cloud
    points = cloud.points @ view.rotation.T + view.translation
    page = PointCloud(points, cloud.colors, cloud.unit, f"camera of {view.name}")
    cameras = [each.relative_to(view) for each in found.views.values()]
    with atomic_path(output / "model.html") as path:
        write_html_page(page, path, notes, cameras)
    images = {name: (folder / name).resolve() for name in found.views}
    cameras_of = found.views, found.intrinsics, {"file_path": images}
    write_transforms(output / "transforms.json", *cameras_of, output / "model.ply")
    values = {**found.summary(), "files": [str(path) for path in found.files]}
    write_whole(output / "model.json", json.dumps(values, indent=2) + "\n")
    failed = []
    for name in formats:
        try:
            FORMATS[name].write(found, folder, output)
        except ReconstructionError as error:  # the other formats may still succeed
            failed.append(str(error))
    if failed:
        raise ReconstructionError("; ".join(failed) + " (all other files were written)")


def _why_unregistered(
    name: str, verified: Mapping[Pair, int], components: Iterable[frozenset[str]]
) -> str:
    """Return a sentence on why an image is not part of the model."""
    for names in components:
        if name in names:
            return (
                f"it is connected with only {len(names) - 1} other images, and these overlap too "
                "little with the rest"
            )
    if partners := sum(name in pair for pair in verified):
        return (
            f"it matches {partners} other images, but the matches give no pose: take more images "
            "in between"
        )
    return "it matches no other image: it shows something else, or was taken from too far away"
