"""A folder of photographs in; cameras, sparse and dense points out.

Features and matches are those of `batch`, in HDF5 files; COLMAP maps. What each stage makes is kept
in the folder of the results: a run that was killed goes on, and new photographs are added.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .. import __version__
from .._shared.atomic import atomic_path
from .._shared.errors import ImageError, OptionError, ReconstructionError
from .._shared.options import check_ranges, replace_options, suggest_keywords
from .._shared.parallel import available_memory, map_in_processes, processor_count
from .._shared.progress import progress
from .._shared.timing import StageTimer
from ..batch.extraction import extract_features
from ..batch.pair_matching import PairMatchingOptions, match_pairs, pair_name
from ..batch.parted_file import open_hdf5
from ..features.selection import SelectionOptions
from ..geometry.camera import Calibration, Camera, read_calibration
from ..geometry.point_cloud import PointCloud
from ..io.exif import camera_from_exif
from ..io.html_viewer import ViewerCamera, write_html_page
from ..io.image import find_images, load_image, luma
from ..io.point_cloud import save_point_cloud
from .colmap import import_pycolmap
from .database import DatabaseImage, write_database
from .dense import (
    DenseOptions,
    DensePoints,
    Reference,
    dense_points,
    find_references,
    limited_view,
    merge_dense_points,
)
from .lens import Lens
from .mapping import (
    MappingOptions,
    SparseModel,
    adjust,
    align_tracks,
    map_photographs,
    normalise_model,
    read_sparse_model,
    verify_pairs,
    write_sparse_model,
)
from .pair_selection import (
    Pair,
    PairSelectionOptions,
    all_pairs,
    sequential_pairs,
    similar_pairs,
    vlad_vectors,
)
from .result import MultiViewReconstruction

MAX_KEYPOINTS = 8192
"""Of a photograph, where nothing else is asked for."""

MIN_KEYPOINTS = 15
"""With fewer a photograph cannot be matched."""

WORK = "work"
"""Folder of what the stages made."""

BYTES_PER_PIXEL = 700
"""That dense matching takes at its peak: it bounds the number of processes."""


def _points() -> SelectionOptions:
    return SelectionOptions(max_keypoints=MAX_KEYPOINTS)


def _matching() -> PairMatchingOptions:
    return PairMatchingOptions(ratio=0.85, mutual=True)


@dataclass(frozen=True, eq=False)
class MultiViewOptions:
    """How many photographs become cameras and points.

    Attributes:
        selection: which points become keypoints.
        pair_selection: which photographs are matched with each other.
        matching: of their keypoints.
        mapping: of cameras and sparse points.
        dense: of dense points; None: there are none.
        single_camera: whether photographs of one size were taken by one camera; None: where their
            EXIF gives one focal length, or none.

    Raises:
        OptionError: a value is out of its range.
    """

    selection: SelectionOptions = field(default_factory=_points)
    pair_selection: PairSelectionOptions = field(default_factory=PairSelectionOptions)
    matching: PairMatchingOptions = field(default_factory=_matching)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    dense: DenseOptions | None = field(default_factory=DenseOptions)
    single_camera: bool | None = None

    def __post_init__(self) -> None:
        check_ranges(self)


@suggest_keywords
def reconstruct_many(
    images: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    calibration: Camera | Calibration | str | Path | None = None,
    focal_px: float | None = None,
    pairs: Literal["auto", "all", "sequential", "similar"] | None = None,
    sequential: int | None = None,
    max_keypoints: int | None = None,
    dense: bool = True,
    stride_px: int | None = None,
    refine_tracks: bool | None = None,
    single_camera: bool | None = None,
    detector: Mapping[str, Any] | None = None,
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
        calibration: JSON file of the camera (docs/reconstruction.md describes its format), or a
            `Camera`, which is taken to be exact. Without one the focal length begins with
            `focal_px`, EXIF, or a guess, and is estimated with the distortion.
        focal_px: focal length in pixels of all photographs, roughly.
        pairs: which photographs are matched: all, sequential (neighbours by name), similar, or auto
            (all of up to 50, else similar).
        sequential: number of following photographs that each is matched with; implies `pairs`.
        max_keypoints: of each photograph.
        dense: whether dense points are made.
        stride_px: a dense point is sought at every so many pixels of a row and of a column.
        refine_tracks: whether the patches around the observations of each sparse point are aligned,
            and all is adjusted once more; None: where the cameras are estimated.
        single_camera: whether photographs of one size were taken by one camera.
        detector: arguments of `DeepDetect`.
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
        ReconstructionError: fewer than three photographs can be read, or they do not hang together.
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
        "max_keypoints": max_keypoints,
        "stride_px": stride_px if chosen.dense is not None else None,
        "refine_tracks": refine_tracks,
        "single_camera": single_camera,
    }
    chosen = replace_options(
        chosen, **{name: value for name, value in given.items() if value is not None}
    )
    if seed is not None:
        chosen = _seeded(chosen, seed)
    if not dense:
        chosen = replace(chosen, dense=None)
    import_pycolmap()  # before hours of work
    target = Path(output)
    if target.is_file() or target.suffix.lower() in (".ply", ".glb", ".html"):
        raise OptionError(f"{target} is the name of a file: give the name of a folder with -o")
    if overwrite and (target / WORK).exists():
        shutil.rmtree(target / WORK)
    run = _Run(target, chosen, workers, quiet)
    return run.reconstruct(images, calibration, focal_px, detector)


def _seeded(options: MultiViewOptions, seed: int) -> MultiViewOptions:
    """Return options with this seed for everything."""
    return replace(
        options,
        pair_selection=replace(options.pair_selection, seed=seed),
        matching=replace(options.matching, seed=seed),
        mapping=replace(options.mapping, seed=seed),
    )


@dataclass(frozen=True, eq=False)
class _Features:
    """What is known of the photographs that could be read."""

    sizes: dict[str, tuple[int, int]]
    keypoints: dict[str, int]
    failures: dict[str, str]


class _Run:
    """One reconstruction, stage by stage."""

    def __init__(
        self, output: Path, options: MultiViewOptions, workers: int | None, quiet: bool
    ) -> None:
        self.output, self.work = output, output / WORK
        self.options, self.workers, self.quiet = options, workers, quiet
        self.timer = StageTimer(None)

    def reconstruct(
        self,
        images: str | Path | Sequence[str | Path],
        calibration: Camera | Calibration | str | Path | None,
        focal_px: float | None,
        detector: Mapping[str, Any] | None,
    ) -> MultiViewReconstruction:
        folder = self._folder(images)
        with self.timer.stage("features"):
            features = self._extract(folder, detector)
        names = [name for name, count in features.keypoints.items() if count >= MIN_KEYPOINTS]
        left_out = dict(features.failures)
        for name, count in features.keypoints.items():
            if count < MIN_KEYPOINTS:
                left_out[name] = (
                    f"it has {count} keypoints: it is black, blurred, or shows nothing with texture"
                )
        if len(names) < self.options.mapping.min_views:
            raise ReconstructionError(
                f"{len(names)} of {len(names) + len(left_out)} photographs can be used, "
                f"{self.options.mapping.min_views} are needed: " + _listed(left_out)
            )
        with self.timer.stage("matching"):
            pairs = self._choose_pairs(names)
            matches = self._match(pairs)
        lenses = self._lenses(
            folder, {name: features.sizes[name] for name in names}, calibration, focal_px
        )
        with self.timer.stage("mapping"):
            model, verified, others = self._map(
                folder, names, lenses, matches, calibration is not None
            )
        sources = {name: lens.source for name, lens in lenses.items()}
        sparse = read_sparse_model(model, sources)
        registered = {view.name for view in sparse.views.values()}
        for name in names:
            if name not in registered:
                left_out[name] = _why_left_out(name, verified, others)
        with self.timer.stage("dense points"):
            dense = self._dense(folder, sparse)
        with self.timer.stage("files"):
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
                self.timer.seconds,
                self._files(),
            )
            self._write(found)
        return found

    def _folder(self, images: str | Path | Sequence[str | Path]) -> Path:
        """Return the folder of the photographs: for a list, one with links to them."""
        if isinstance(images, (str, Path)):
            folder = Path(images)
            if self.output.resolve() == folder.resolve():
                raise OptionError(f"{folder} holds the photographs: give another folder with -o")
            return folder
        paths = [Path(path) for path in images]
        missing = [path for path in paths if not path.is_file()]
        if missing:
            raise ImageError(f"there is no file {missing[0]}: check the path")
        taken: dict[str, Path] = {}
        for path in paths:
            if taken.setdefault(path.name, path).resolve() != path.resolve():
                raise OptionError(
                    f"{taken[path.name]} and {path} have one name: rename one of them"
                )
        folder = self.work / "images"
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.iterdir():
            if old.name not in taken:
                old.unlink()
        for name, path in taken.items():
            _link(path, folder / name)
        return folder

    def _extract(self, folder: Path, detector: Mapping[str, Any] | None) -> _Features:
        report = extract_features(
            folder,
            self.work / "features.h5",
            selection=self.options.selection,
            detector=detector,
            workers=self.workers,
            quiet=self.quiet,
        )
        sizes, keypoints, failures = {}, {}, {}
        names = [path.relative_to(folder).as_posix() for path in find_images(folder)]
        if not (self.work / "features.h5").exists():
            raise ReconstructionError("no photograph can be read: " + "; ".join(report.failures))
        with open_hdf5(self.work / "features.h5") as file:
            for name in names:
                sentence = [text for text in report.failures if name in text]
                if sentence:
                    failures[name] = sentence[0]
                elif name in file:
                    width, height = file[name]["image_size"][()]
                    sizes[name] = int(width), int(height)
                    keypoints[name] = len(file[name]["keypoints"])
        return _Features(sizes, keypoints, failures)

    def _choose_pairs(self, names: list[str]) -> list[Pair]:
        options = self.options.pair_selection
        way = options.way(len(names))
        if way == "all":
            return all_pairs(names)
        if way == "sequential":
            return sequential_pairs(names, options.sequential)
        descriptors = []
        with open_hdf5(self.work / "features.h5") as file:
            for name in names:
                best = np.argsort(-file[name]["scores"][()], kind="stable")[: options.keypoints]
                descriptors.append(file[name]["descriptors"][()].T[best])
        return similar_pairs(names, vlad_vectors(descriptors, options), options.similar)

    def _match(self, pairs: list[Pair]) -> dict[Pair, np.ndarray]:
        path = self.work / "matches.h5"
        match_pairs(
            self.work / "features.h5",
            pairs,
            path,
            options=self.options.matching,
            workers=self.workers,
            quiet=self.quiet,
        ).check()
        found = {}
        with open_hdf5(path) as file:
            for pair in pairs:
                turned = pair_name(*pair) not in file
                group = file[pair_name(*(pair[::-1] if turned else pair))]
                matches = group["matches0"][()]
                rows = np.flatnonzero(matches >= 0)
                both = np.column_stack([rows, matches[rows]])
                found[pair] = both[:, ::-1] if turned else both
        return found

    def _lenses(
        self,
        folder: Path,
        sizes: Mapping[str, tuple[int, int]],
        calibration: Camera | Calibration | str | Path | None,
        focal_px: float | None,
    ) -> dict[str, Lens]:
        """Return the camera of each photograph, the same object for those that share one."""
        if calibration is not None and focal_px is not None:
            raise ReconstructionError("give `calibration` or `focal_px`, not both")
        shared: dict[tuple[Any, ...], Lens] = {}
        lenses = {}
        for name, size in sizes.items():
            if calibration is not None:
                lens = Lens.of_camera(_known_camera(calibration, size, name))
            elif focal_px is not None:
                lens = replace(
                    Lens.initial(size, Camera(size, focal_px).focal_px[0]), source="focal_px"
                )
            else:
                try:
                    focal = float(np.mean(camera_from_exif(folder / name, size).focal_px))
                except ReconstructionError:
                    lens = Lens.initial(size)
                else:
                    lens = Lens.initial(size, focal)
            key: tuple[Any, ...] = (lens,)
            if self.options.single_camera is True:
                key = (size,)
            elif self.options.single_camera is False:
                key = (name,)
            lenses[name] = shared.setdefault(key, lens)
        return lenses

    def _map(
        self,
        folder: Path,
        names: Sequence[str],
        lenses: Mapping[str, Lens],
        matches: Mapping[Pair, np.ndarray],
        known: bool,
    ) -> tuple[Any, dict[Pair, int], list[frozenset[str]]]:
        """Map, or read what an earlier run has mapped."""
        pycolmap = import_pycolmap()
        options = self.options.mapping
        images = []
        with open_hdf5(self.work / "features.h5") as file:
            for name in names:
                images.append(DatabaseImage(name, lenses[name], file[name]["keypoints"][()]))
        shared = {id(lens): number for number, lens in enumerate(lenses.values())}
        digest = _digest(
            *(
                part
                for image in images
                for part in (image.name, image.lens, shared[id(image.lens)], image.xy)
            ),
            *(part for pair, rows in matches.items() for part in (pair, rows)),
            asdict(options),
            known,
            pycolmap.__version__,
        )
        record = self.work / "mapping.json"
        sparse = self.output / "sparse"
        noted = _read_json(record)
        if noted.get("digest") == digest and (sparse / "points3D.bin").exists():
            pairs = {(a, b): count for a, b, count in noted["verified"]}
            return pycolmap.Reconstruction(sparse), pairs, [frozenset(s) for s in noted["others"]]
        with atomic_path(self.output / "database.db") as path:
            path.unlink()
            write_database(path, images, matches)
            with progress(len(matches), "verifying", "pair", self.quiet) as bar:
                verified = verify_pairs(path, options, bar.update)
        space = self.work / "mapping"
        shutil.rmtree(space, ignore_errors=True)
        space.mkdir()
        with progress(len(images), "mapping", "photograph", self.quiet) as bar:
            model, others = map_photographs(
                self.output / "database.db", folder, space, known, options, bar.update
            )
        shutil.rmtree(space, ignore_errors=True)
        if options.refine_tracks or (options.refine_tracks is None and not known):
            grays = {
                model.images[number].name: luma(load_image(folder / model.images[number].name))
                for number in model.reg_image_ids()
            }
            align_tracks(model, grays, options.track_refinement)
            adjust(model, known, options.refined_scale_px, options)
        else:
            adjust(model, known, options.robust_scale_px, options)
        normalise_model(model)
        record.unlink(missing_ok=True)
        write_sparse_model(model, sparse)
        values = {
            "digest": digest,
            "verified": [[*pair, count] for pair, count in verified.items()],
            "others": [sorted(other) for other in others],
        }
        with atomic_path(record) as path:
            path.write_text(json.dumps(values), encoding="utf-8")
        return model, verified, others

    def _dense(self, folder: Path, sparse: SparseModel) -> DensePoints:
        """Make the dense points that earlier runs have not made, and join all."""
        options = self.options.dense
        if options is None:
            return DensePoints.joined([])
        store = self.work / "dense"
        store.mkdir(parents=True, exist_ok=True)
        references = find_references(sparse, options)
        paths = {}
        for reference in references:
            names = [reference.view.name, *(each.view.name for each in reference.neighbours)]
            digest = _digest(
                *(_state(folder / name) for name in names),
                *_contents(reference.view, reference.lens),
                *(
                    part
                    for each in reference.neighbours
                    for part in (*_contents(each.view, each.lens), each.points0, each.points1)
                ),
                asdict(options),
                __version__,
            )
            paths[store / f"{digest[:32]}.npz"] = reference
        for old in store.glob("*.npz"):
            if old not in paths:
                old.unlink()
        tasks = [(path, reference) for path, reference in paths.items() if not path.exists()]
        work = partial(_dense_task, folder=folder.absolute(), options=options)
        done = len(paths) - len(tasks)
        with progress(len(paths), "dense points", "photograph", self.quiet, done) as bar:
            for _ in map_in_processes(work, tasks, self._dense_workers(sparse)):
                bar.update()
        parts = [
            (limited_view(reference.view, options), _load_dense(path))
            for path, reference in paths.items()
        ]
        return merge_dense_points(parts, options)

    def _dense_workers(self, sparse: SparseModel) -> int:
        options = self.options.dense or DenseOptions()
        pixels = max(
            view.camera.size[0]
            * view.camera.size[1]
            * min(1, options.max_side_px / max(view.camera.size)) ** 2
            for view in sparse.views.values()
        )
        fitting = max(1, int(available_memory() // (BYTES_PER_PIXEL * pixels)))
        return min(self.workers or processor_count(), fitting)

    def _files(self) -> tuple[Path, ...]:
        names = ("model.ply", "model.glb", "model.html", "model.json", "sparse", "database.db")
        return tuple(self.output / name for name in names)

    def _write(self, found: MultiViewReconstruction) -> None:
        """Write the files of the model, the JSON last."""
        notes = {
            "title": f"{len(found.views)} photographs",
            "photographs": f"{len(found.views)} of {len(found.views) + len(found.left_out)}",
            "sparse points": f"{len(found.sparse):,}",
        }
        save_point_cloud(found.cloud, self.output / "model.ply", notes)
        save_point_cloud(found.cloud, self.output / "model.glb", notes)
        cameras = [
            ViewerCamera(name, view.camera, view.rotation, np.asarray(view.translation))
            for name, view in found.views.items()
        ]
        with atomic_path(self.output / "model.html") as path:
            write_html_page(found.cloud, path, notes, cameras)
        values = {**found.summary(), "files": [str(path) for path in found.files]}
        with atomic_path(self.output / "model.json") as path:
            path.write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _link(source: Path, place: Path) -> None:
    """Make a file appear at a place: a link where the system has them, else a copy."""
    if place.exists() and place.samefile(source):
        return
    place.unlink(missing_ok=True)
    try:
        place.symlink_to(source.resolve())
    except OSError:
        shutil.copy2(source, place)


def _known_camera(
    calibration: Camera | Calibration | str | Path, size: tuple[int, int], name: str
) -> Camera:
    """Return the camera of a photograph by a calibration."""
    if isinstance(calibration, Calibration):
        calibration = calibration.camera0
    if not isinstance(calibration, Camera):
        return read_calibration(calibration, size, size).camera0
    if calibration.size != size:
        raise ReconstructionError(
            f"the calibration is for images of {calibration.size[0]}x{calibration.size[1]} pixels, "
            f"{name} has {size[0]}x{size[1]}: give photographs of one size, or no calibration"
        )
    return calibration


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


DenseTask = tuple[Path, Reference]


def _dense_task(task: DenseTask, folder: Path, options: DenseOptions) -> None:
    """Write the dense points of one photograph."""
    path, reference = task
    found = dense_points(folder, reference, options)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **vars(found))


def _load_dense(path: Path) -> DensePoints:
    with np.load(path, allow_pickle=False) as file:
        return DensePoints(**{name: file[name] for name in file.files})


def _contents(view: Any, lens: Lens) -> tuple[Any, ...]:
    return view.name, view.camera, np.asarray(view.rotation), np.asarray(view.translation), lens


def _state(path: Path) -> str:
    """Return what changes when a file does."""
    try:
        found = path.stat()
    except OSError as error:
        raise ImageError(f"{path} cannot be read any more ({error.strerror})") from None
    return f"{found.st_size} {found.st_mtime_ns}"


def _digest(*parts: Any) -> str:
    """Return a digest of arrays and of anything whose `repr` says all."""
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).tobytes())
        else:
            digest.update(repr(part).encode("utf-8", "surrogateescape"))
        digest.update(b"\0")
    return digest.hexdigest()


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def _listed(reasons: Mapping[str, str]) -> str:
    shown = [f"{name}: {reason}" for name, reason in list(reasons.items())[:3]]
    return "; ".join(shown) or "take more photographs"
