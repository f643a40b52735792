"""A folder of photographs in; cameras, sparse and dense points out.

Features and matches are those of `batch`, in HDF5 files; COLMAP maps. What each stage makes is kept
in the folder of the results: a run that was killed goes on, and new photographs are added.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import OptionError, ReconstructionError
from .._shared.options import replace_options, suggest_keywords
from .._shared.timing import StageTimer
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.selection import SelectionOptions
from ..geometry.camera import Calibration, Camera
from ..geometry.point_cloud import PointCloud
from ..io.html_viewer import write_html_page
from ..io.image import load_image
from ..io.point_cloud import save_point_cloud
from .colmap import import_pycolmap
from .intrinsics import known_cameras, photograph_lenses
from .mapping import SparseModel, read_sparse_model
from .options import MultiViewOptions
from .pair_selection import Pair
from .result import MultiViewReconstruction
from .stages import WORK, Stages

MAX_KEYPOINTS = 8192
"""Of a photograph, where nothing else is asked for."""

MIN_KEYPOINTS = 15
"""With fewer a photograph cannot be matched."""


@suggest_keywords
def reconstruct_many(
    images: str | Path | Sequence[str | Path],
    output: str | Path,
    detector: DeepDetect | PointDetector = PointDetector(MAX_KEYPOINTS),
    *,
    selection: SelectionOptions | None = None,
    calibration: Camera | Calibration | str | Path | None = None,
    focal_px: float | None = None,
    pairs: Literal["auto", "all", "sequential", "similar"] | None = None,
    sequential: int | None = None,
    dense: bool = True,
    stride_px: int | None = None,
    single_camera: bool | None = None,
    seed: int | None = None,
    options: MultiViewOptions | None = None,
    workers: int | None = None,
    overwrite: bool = False,
    quiet: bool = True,
) -> MultiViewReconstruction:
    """Reconstruct the cameras and a dense model from three or more photographs of a scene.

    Writes into the folder `output`: model.ply, model.glb, model.html (a viewer, with the cameras),
    model.json, sparse/ and database.db (COLMAP's), and work/ with what each stage made. A call that
    was interrupted or killed goes on when it is made again. A script must call this under
    `if __name__ == "__main__":`, since processes are started.

    Every option that is None is as in `options`.

    Args:
        images: a folder, or image files.
        output: folder for the results.
        detector, selection: as of `extract_features`.
        calibration: JSON file of the camera (docs/reconstruction.md describes its format), or a
            `Camera`, which is taken to be exact. Without one the focal length begins with
            `focal_px`, EXIF, or a guess, and is estimated with the distortion.
        focal_px: focal length in pixels of all photographs, roughly.
        pairs: which photographs are matched: all, sequential (neighbours by name), similar, or auto
            (all of up to 50, else similar).
        sequential: number of following photographs that each is matched with; implies `pairs`.
        dense: whether dense points are made.
        stride_px: a dense point is sought at every so many pixels of a row and of a column.
        single_camera: whether photographs of one size were taken by one camera.
        seed: of all random choices.
        options: all options at once.
        workers: number of processes; default one per processor.
        overwrite: do all of it again.
        quiet: show no progress bars.

    Returns:
        Cameras and points. Photographs that are no part of it are in `left_out`, with the reason.

    Raises:
        ImageError: the folder is missing or holds no image.
        OptionError: an option is unknown or out of its range, or the results were made with others.
        ReconstructionError: fewer than three photographs can be read, or (a `NoDepthError`) they do
            not hang together.
        MissingExtraError: pycolmap or h5py is not installed.

    Example:
        >>> if __name__ == "__main__":  # doctest: +SKIP
        ...     found = reconstruct_many("photos", "model", quiet=False)
        ...     found.centres, found.dense.points, found.left_out
    """
    chosen = MultiViewOptions() if options is None else options
    given = {
        "pairs": "sequential" if pairs is None and sequential is not None else pairs,
        "sequential": sequential,
        "stride_px": stride_px if chosen.dense is not None else None,
        "single_camera": single_camera,
    }
    chosen = replace_options(
        chosen, **{name: value for name, value in given.items() if value is not None}
    )
    if seed is not None:
        chosen = _seeded(chosen, seed)
    if not dense:
        chosen = replace(chosen, dense=None)
    import_pycolmap()  # what is missing is said before hours of work
    target = Path(output)
    check_output_folder(target)
    if overwrite and (target / WORK).exists():
        shutil.rmtree(target / WORK)
    if calibration is not None and focal_px is not None:
        raise ReconstructionError("give `calibration` or `focal_px`, not both")
    stages = Stages(target, chosen, workers, quiet)
    return _reconstruct(stages, images, calibration, focal_px, detector, selection)


def check_output_folder(output: Path) -> None:
    """Raise an OptionError where results cannot be in a folder of this name."""
    if output.is_file() or output.suffix.lower() in (".ply", ".glb", ".html"):
        raise OptionError(f"{output} is the name of a file: give the name of a folder with -o")


def _seeded(options: MultiViewOptions, seed: int) -> MultiViewOptions:
    """Return options with this seed for everything."""
    return replace(
        options,
        pair_selection=replace(options.pair_selection, seed=seed),
        matching=replace(options.matching, seed=seed),
        mapping=replace(options.mapping, seed=seed),
    )


def _reconstruct(
    stages: Stages,
    images: str | Path | Sequence[str | Path],
    calibration: Camera | Calibration | str | Path | None,
    focal_px: float | None,
    detector: DeepDetect | PointDetector,
    selection: SelectionOptions | None,
) -> MultiViewReconstruction:
    """Go through all stages, and write the results."""
    timer, options = StageTimer(None), stages.options
    folder = stages.folder_of(images)
    with timer.stage("features"):
        features = stages.extract(folder, detector, selection)
    names = [name for name, count in features.keypoints.items() if count >= MIN_KEYPOINTS]
    left_out = dict(features.failures)
    for name, count in features.keypoints.items():
        if count < MIN_KEYPOINTS:
            left_out[name] = (
                f"it has {count} keypoints: it is black, blurred, or shows nothing with texture"
            )
    if len(names) < options.mapping.min_views:
        raise ReconstructionError(
            f"{len(names)} of {len(names) + len(left_out)} photographs can be used, "
            f"{options.mapping.min_views} are needed: " + _listed(left_out)
        )
    cameras = known_cameras(calibration, {name: features.sizes[name] for name in names})
    left_out |= cameras.refused
    names = [name for name in names if name not in cameras.refused]
    with timer.stage("matching"):
        pairs = stages.choose_pairs(names)
        matches = stages.match(pairs)
    lenses = photograph_lenses(
        folder, names, features.sizes, cameras.known, focal_px, options.single_camera
    )
    with timer.stage("mapping"):
        model, verified, others = stages.map(
            folder, names, lenses, matches, calibration is not None
        )
    sources = {name: lens.source for name, lens in lenses.items()}
    sparse = read_sparse_model(model, sources)
    registered = {view.name for view in sparse.views.values()}
    for name in names:
        if name not in registered:
            left_out[name] = _why_left_out(name, verified, others)
    with timer.stage("dense points"):
        dense = stages.dense(folder, sparse)
    with timer.stage("files"):
        colors = _sparse_colors(folder, sparse)
        order = sorted(sparse.views, key=lambda number: sparse.views[number].name)
        reference = min(
            order, key=lambda number: float(np.linalg.norm(sparse.views[number].centre))
        )
        frame = f"camera of {sparse.views[reference].name}"
        found = MultiViewReconstruction(
            {sparse.views[number].name: sparse.views[number] for number in order},
            {sparse.views[number].name: sparse.lenses[number] for number in order},
            dict(sorted(left_out.items())),
            _groups_of(left_out, others),
            sparse.views[reference].name,
            PointCloud(sparse.points, colors, "spacing", frame),
            sparse.errors.astype(np.float32),
            sparse.tracks.astype(np.int32),
            PointCloud(dense.points, dense.colors, "spacing", frame),
            dense.errors,
            dense.views,
            features.keypoints,
            verified,
            len(pairs),
            options.pair_selection.way(len(names)),
            timer.seconds,
            output_files(stages.output)[:-1],
        )
        _write(found, stages.output)
    return found


def output_files(output: Path) -> tuple[Path, ...]:
    """Name all that is written into the folder of the results; the last is what stages made."""
    names = ("model.ply", "model.glb", "model.html", "model.json", "sparse", "database.db", WORK)
    return tuple(output / name for name in names)


def _write(found: MultiViewReconstruction, output: Path) -> None:
    """Write the files of the model, the JSON last."""
    notes = {
        "title": f"{len(found.views)} photographs",
        "photographs": f"{len(found.views)} of {len(found.views) + len(found.left_out)}",
        "sparse points": f"{len(found.sparse):,}",
    }
    save_point_cloud(found.cloud, output / "model.ply", notes)
    save_point_cloud(found.cloud, output / "model.glb", notes)
    with atomic_path(output / "model.html") as path:
        write_html_page(found.cloud, path, notes, list(found.views.values()))
    values = {**found.summary(), "files": [str(path) for path in found.files]}
    with atomic_path(output / "model.json") as path:
        path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _why_left_out(name: str, verified: Mapping[Pair, int], others: Iterable[frozenset[str]]) -> str:
    """Say why a photograph is no part of the model."""
    for other in others:
        if name in other:
            return (
                f"it hangs together with {len(other) - 1} others only, which show something else, "
                "or too little of the same"
            )
    partners = sum(name in pair for pair in verified)
    if not partners:
        return "it matches none of the others: it shows something else, or from too far away"
    return (
        f"it matches {partners} of the others, but its pose cannot be told from them: take more "
        "photographs between"
    )


def _groups_of(
    left_out: Iterable[str], others: Iterable[frozenset[str]]
) -> tuple[tuple[str, ...], ...]:
    """Return the names of those left out that hang together, without what two models share."""
    groups = [tuple(sorted(other & frozenset(left_out))) for other in others]
    return tuple(sorted((group for group in groups if len(group) > 1), key=len, reverse=True))


def _sparse_colors(folder: Path, sparse: SparseModel) -> np.ndarray:
    """Return the (P, 3) uint8 mean colours of the points in the photographs that see them."""
    sums, counts = np.zeros((len(sparse.points), 3)), np.zeros(len(sparse.points))
    for number, view in sparse.views.items():
        own = np.flatnonzero(sparse.seen.views == number)
        rgb = load_image(folder / view.name)
        places = sparse.lenses[number].from_pinhole(sparse.seen.xy[own])
        column, row = np.rint(places).astype(np.int64).T
        column, row = column.clip(0, rgb.shape[1] - 1), row.clip(0, rgb.shape[0] - 1)
        np.add.at(sums, sparse.seen.points[own], rgb[row, column])
        np.add.at(counts, sparse.seen.points[own], 1)
    return np.rint(sums / np.maximum(counts, 1)[:, None]).astype(np.uint8)


def _listed(reasons: Mapping[str, str]) -> str:
    shown = [f"{name}: {reason}" for name, reason in list(reasons.items())[:3]]
    return "; ".join(shown) or "take more photographs"
