"""Run the stages of a reconstruction of many images, and cache their results.

Features and matches are cached in the HDF5 files of `batch`. Models and depth maps are stored under
a key that is computed from everything they depend on. A later run reuses those with the same key.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .. import __version__
from .._shared.atomic import atomic_path, write_whole
from .._shared.errors import (
    ImageError,
    MissingImageError,
    OptionError,
    ReconstructionError,
    check_name,
)
from .._shared.machine import available_memory, map_in_processes, needed_memory, processor_count
from .._shared.options import check_ranges, suggest_keywords
from .._shared.progress import progress
from .._shared.records import file_state, key, load_arrays, save_arrays
from ..batch.extraction import extract_features
from ..batch.hdf5 import feature_names, open_hdf5
from ..batch.pair_list import Pair, following, list_pairs, motion, pair_name, similar, thin_out
from ..batch.pair_matching import PairMatchingOptions, first_keypoints, match_pairs
from ..batch.similar_pairs import similar_pairs
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.keypoints import Keypoints
from ..features.match_filter import suits_filter
from ..features.selection import SelectionOptions
from ..geometry.camera import PosedView
from ..io.image import find_images, load_image, luma, name_images
from ..io.image_file import IMAGE_SUFFIXES, ReadingOptions, is_path, read_with, reading_options
from ..io.projection import MIN_ASPECT, require_pinhole
from ..matching.overlay import find_overlay, tell_still
from .colmap import CameraIntrinsics, import_pycolmap, write_database
from .depth_maps import MATCHED_NEIGHBOURS, depth_map, find_references, limited_view
from .formats import FormatName
from .fusion import fuse_depth_maps, merge_dense_points
from .mapping import (
    MIN_VIEWS,
    RegisteredImage,
    SparseModel,
    adjust,
    adjust_refined,
    map_globally,
    map_images,
    normalise_model,
    read_sparse_model,
    require_pinholes,
    verify_pairs,
)
from .misplaced import correct_places
from .tracks import add_dense_tracks, refine_tracks

MAX_EXHAUSTIVE = 50
"""The option `pairs="auto"` matches all pairs of at most this many images."""

WORK = "work"
"""Name of the folder of intermediate results, inside the output folder."""

LINKS = ".images"
"""Name of a folder inside `WORK` with links to the images, if the user gave a list of files. The
folder is hidden, so that a search for images in a folder above does not find them twice."""

COMPARED_RUNS = 8
"""An overlay is searched for in this many groups of three images with successive names, which are
mostly from one camera. The groups are spread over all images. Chosen by hand."""


@suggest_keywords
@dataclass(frozen=True)
class MultiViewOptions:
    """Options of the reconstruction of many images.

    Attributes:
        pairs: pairs of images to match: "exhaustive" (all pairs), "sequential:10" (each image with
            the 10 that follow it by name), "similar:20" (with the 20 most similar ones), or "auto"
            (exhaustive for up to 50 images, else similar:20).
        min_motion: leave out an image if the median motion of its matched keypoints, relative to an
            earlier image, is below this fraction of the longer side, as in most frames of a video.
            None uses all images.
        matches: "sparse" (the points of the sparse model come from keypoints only) or "dense" (they
            also come from depth maps, and the cameras are adjusted to all of them).
        mapper: how COLMAP estimates the poses: "incremental" (one image after the other) or
            "global" (all at once, which saves time only for a thousand images or more).
        dense: compute dense points.
        stride_px: try every N-th pixel of every N-th row as a dense point.
        single_camera: whether all images of one size share a camera, or each image has its own. By
            default, images of one size share a camera if EXIF gives them the same focal length, or
            gives none.
        control_points: file of ground control points in the format of OpenDroneMap's gcp_list.txt;
            they replace the GPS of the images.
        scale_by: a known length in metres and its two ends. An end is an image, which stands for
            its camera, or a pixel of an image, such as IMG_1.jpg:120,340.
        formats: further file formats in which the model is written.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    pairs: str = "auto"
    min_motion: float | None = None
    matches: Literal["sparse", "dense"] = "sparse"
    mapper: Literal["incremental", "global"] = "incremental"
    dense: bool = True
    stride_px: int = 2
    single_camera: bool | None = None
    control_points: str | Path | None = None
    scale_by: tuple[float, str, str] | None = None
    formats: tuple[FormatName, ...] = ()

    def __post_init__(self) -> None:
        if self.scale_by is not None and not 0 < self.scale_by[0] < np.inf:
            raise OptionError(f"`scale_by` must be a length above 0 m, not {self.scale_by[0]}")
        if self.pairs != "auto" and not (following(self.pairs) or similar(self.pairs)):
            raise OptionError(
                "`pairs` must be 'auto', 'exhaustive', or like 'sequential:10' or 'similar:20', "
                f"not '{self.pairs}'"
            )
        check_name("matches", self.matches, ("sparse", "dense"))
        check_name("mapper", self.mapper, ("incremental", "global"))
        if "mesh" in self.formats and not self.dense:
            raise OptionError("the format 'mesh' needs dense points: leave out `dense=False`")
        check_ranges(self, counts=("stride_px",), fractions=("min_motion",))

    def pair_choice(self, count: int) -> str:
        """Return the choice of the pairs of `count` images, with "auto" replaced by its meaning."""
        if self.pairs != "auto":
            return self.pairs
        return "exhaustive" if count <= MAX_EXHAUSTIVE else "similar"


def check_images(
    images: str | Path | Sequence[str | Path], exclude: Sequence[Path] = ()
) -> dict[str, Path]:
    """Return the paths of the images that are below a folder or in a list, by image name."""
    if isinstance(images, (str, Path)):
        folder = Path(images)
        return {path.relative_to(folder).as_posix(): path for path in find_images(folder, exclude)}
    if not np.iterable(images) or not all(map(is_path, images)):
        raise OptionError("give a folder, or a list of image files")
    paths = [*map(Path, images)]
    for path in paths:
        if not path.is_file():
            raise MissingImageError(f"there is no file {path}: check the path")
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            load_image(path)  # raises an error with advice if it is a video
            raise OptionError(f"{path} does not end in .jpg, .png or another image type: rename it")
    return name_images(paths)


class Stages:
    """The stages of a reconstruction; their results are kept in the folder `output`."""

    def __init__(
        self,
        output: Path,
        options: MultiViewOptions,
        workers: int | None,
        quiet: bool,
        seed: int = 0,
    ) -> None:
        self.output, self.work = output, output / WORK
        self.options, self.workers, self.quiet, self.seed = options, workers, quiet, seed
        self.matching = PairMatchingOptions(seed=seed)
        self.features = self.work / "features.h5"
        self.left_out = 0.0

    def folder_of(self, images: str | Path | Sequence[str | Path]) -> Path:
        """Return a folder that holds all images, and no results.

        For a list of files, or an output folder among the images, it holds links to the images.
        """
        if isinstance(images, (str, Path)):
            if self.output.resolve() == Path(images).resolve():
                raise OptionError(
                    f"{images} holds the images: give another folder for the results with -o"
                )
            if not self.output.resolve().is_relative_to(Path(images).resolve()):
                return Path(images)
        taken = check_images(images, [self.output])  # without images in the output folder
        folder = self.work / LINKS
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for name, path in taken.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            try:
                (folder / name).symlink_to(path.resolve())
            except OSError:  # on Windows, only some users may make links
                shutil.copy2(path, folder / name)
        return folder

    def find_overlays(self, paths: Sequence[Path]) -> list[np.ndarray]:
        """Return the overlay masks, one per image size; the result of an earlier run is reused."""
        file = self.work / "overlays.npz"
        if not self.features.exists():
            found: dict[str, np.ndarray] = {}
            starts = np.linspace(0, max(0, len(paths) - MIN_VIEWS), COMPARED_RUNS).astype(int)
            for start in sorted({*starts.tolist()}):
                grays = []
                with contextlib.suppress(ImageError):  # the extraction reports unreadable images
                    grays = [luma(load_image(path)) for path in paths[start : start + MIN_VIEWS]]
                if len(grays) == MIN_VIEWS and (mask := find_overlay(grays, self.seed)).any():
                    size = "{1}x{0}".format(*mask.shape)
                    found[size] = found.get(size, False) | mask
            save_arrays(file, found)
        overlays = [*(load_arrays(file) or {}).values()]
        self.left_out = max((float(overlay.mean()) for overlay in overlays), default=0.0)
        tell_still(self.left_out)
        return overlays

    def extract(
        self,
        folder: Path,
        detector: DeepDetect | PointDetector,
        selection: SelectionOptions | None = None,
    ) -> tuple[dict[str, tuple[int, int]], dict[str, int], dict[str, str]]:
        """Detect and describe the keypoints of all images below a folder.

        Returns three mappings by image name: the sizes (width, height) and the numbers of keypoints
        of the images that could be read, and, for each other image, a sentence on why it could not.
        """
        overlays = self.find_overlays([folder / name for name in check_images(folder)])
        report = extract_features(
            folder,
            self.features,
            detector,
            selection=selection,
            ignore=overlays,
            workers=self.workers,
            quiet=self.quiet,
        )
        if not self.features.exists():
            raise ReconstructionError("no image can be read: " + "; ".join(report.failures))
        sizes, keypoints, failures = dict[str, tuple[int, int]](), {}, {}
        with open_hdf5(self.features) as file:
            described = {*feature_names(file)}
            for name, path in check_images(folder).items():
                if name in described:
                    width, height = file[name]["image_size"][()]
                    wide = width >= MIN_ASPECT * height
                    looked = wide or not sizes  # look for a fisheye's rim until an image has none
                    try:
                        require_pinhole(path, load_image(path) if looked else None)
                    except ValueError as error:
                        failures[name] = str(error).replace(str(path), "it", 1)
                        continue
                    sizes[name] = int(width), int(height)
                    keypoints[name] = len(file[name]["keypoints"])
                    continue
                path = folder.absolute() / name
                begins, within = (f"{path} ", f"{name}: "), f" {path}:"
                found = [one for one in report.failures if one.startswith(begins) or within in one]
                failures[name] = [*found, "it cannot be read: check the file"][0]
        return sizes, keypoints, failures

    def choose_pairs(self, names: Sequence[str]) -> list[Pair]:
        """Return the pairs of images to match, chosen by the rule in the option `pairs`."""
        choice = self.options.pair_choice(len(names))
        if not (alike := similar(choice)):
            return list_pairs(choice, names)
        return similar_pairs(self.features, names, alike, self.seed, self.quiet)[0]

    def match_images(
        self, sizes: Mapping[str, tuple[int, int]]
    ) -> tuple[dict[Pair, np.ndarray], dict[str, str]]:
        """Choose and match pairs of images, and leave out images that show nothing new.

        `sizes` are (width, height) by image name. Returns the matches as `match` does, and the
        images left out, each with the image that shows nearly the same and is kept.
        """
        names, dropped, limit = [*sizes], dict[str, str](), self.options.min_motion
        while True:
            matches = self.match(self.choose_pairs(names))
            if limit is None:
                return matches, dropped
            with open_hdf5(self.features) as file:
                xy = {name: file[name]["keypoints"][()] for name in names}
            motions = {(a, b): motion(xy[a], xy[b], rows) for (a, b), rows in matches.items()}
            near = {
                pair: moved
                for pair, moved in motions.items()
                if moved < limit * max(sizes[pair[0]]) and sizes[pair[0]] == sizes[pair[1]]
            }
            # Pairs are chosen again, because all partners of an image may have been left out.
            if not (further := thin_out(names, near, dropped)):
                return matches, dropped
            dropped |= further
            names = [name for name in names if name not in further]

    def match(self, pairs: Sequence[Pair]) -> dict[Pair, np.ndarray]:
        """Match pairs of images; return (K, 2) indices of keypoints for each pair.

        Matches are filtered by comparing each with neighbouring matches. The ratio test is used
        instead if the keypoints lack sizes or angles, or their descriptors do not suit the filter.
        """
        path = self.work / "matches.h5"
        first = first_keypoints(self.features)
        suited = first is not None and suits_filter(first)
        how = replace(self.matching, filter_by="neighbours" if suited else "ratio")
        match_pairs(
            self.features, pairs, path, options=how, workers=self.workers, quiet=self.quiet
        ).check()
        found = {}
        with open_hdf5(path) as file:
            for pair in pairs:
                matches = file[pair_name(*pair)]["matches0"][()]
                rows = np.flatnonzero(matches >= 0)
                found[pair] = np.column_stack([rows, matches[rows]]).astype(np.uint32)
        return found

    def map(
        self,
        folder: Path,
        intrinsics: Mapping[str, CameraIntrinsics],
        matches: Mapping[Pair, np.ndarray],
        known: bool,
        refined: bool = True,
    ) -> tuple[Any, dict[Pair, int], list[frozenset[str]]]:
        """Estimate poses and sparse points, or read the model of an earlier run.

        If intrinsics are `known`, they stay fixed. If tracks are not `refined`, they stay at the
        keypoints, and points have no colours. Returns the `pycolmap.Reconstruction`, the number of
        inliers of each verified pair, and the names of the images in each other component.
        """
        pycolmap, options = import_pycolmap(), self.options
        images = {}
        with open_hdf5(self.features) as file:
            for name, own in intrinsics.items():
                xy = file[name]["keypoints"][()]
                images[name] = Keypoints(xy, np.ones(len(xy), np.float32), own.size), own
        cameras = [id(own) for own in intrinsics.values()]
        made_of = key(
            [(name, own, points.xy) for name, (points, own) in images.items()],
            [cameras.index(camera) for camera in cameras],
            list(matches.items()),
            (known, refined, options.matches, options.mapper, self.seed),
            options.stride_px if options.matches == "dense" else None,
            (pycolmap.__version__, __version__),
        )
        record = self.work / f"mapping-{made_of}.json"
        database, sparse = self.output / "database.db", self.work / "sparse"
        with contextlib.suppress(OSError, ValueError):  # the record is missing or damaged
            noted = json.loads(record.read_text(encoding="utf-8"))
            verified = {(a, b): count for a, b, count in noted["verified"]}
            components = [frozenset(names) for names in noted["components"]]
            return pycolmap.Reconstruction(sparse), verified, components
        # SQLite would mistake the log of a killed run's database for the log of the new database.
        for old in (*self.work.glob("mapping-*.json"), *self.output.glob("database.db-*")):
            old.unlink()
        with atomic_path(database) as path:
            path.unlink()
            write_database(path, images, matches)
            verified = verify_pairs(path, self.seed, self.workers)
        with progress(len(images), "mapping", "image", self.quiet) as bar:
            if options.mapper == "global":
                model, components = map_globally(database, folder, known, self.seed)
                bar.update(len(images))
            else:
                model, components = map_images(
                    database,
                    folder,
                    verified,
                    known,
                    self.seed,
                    # A second attempt counts images again, so the bar is kept from overflowing.
                    lambda count: bar.update(min(count, len(images) - bar.n)),
                )
        if not known:
            require_pinholes(model)
        model = correct_places(model, database, folder, known, self.seed, self.quiet)
        if refined:
            refine_tracks(model, folder, self.quiet)
            adjust_refined(model, known)
        else:
            adjust(model, known)
        normalise_model(model)
        if refined and options.matches == "dense":
            fused = self.fused(folder, read_sparse_model(model))
            add_dense_tracks(model, folder, fused)
            adjust_refined(model, known)
            normalise_model(model)
        sparse.mkdir(exist_ok=True)
        model.write(sparse)
        noted = {
            "verified": [[*pair, count] for pair, count in verified.items()],
            "components": [sorted(names) for names in components],
        }
        write_whole(record, json.dumps(noted))
        return model, verified, components

    def dense(self, folder: Path, sparse: SparseModel) -> np.ndarray:
        """Compute the depth maps that are missing, and fuse all maps into (N,) `DENSE_POINT`."""
        return merge_dense_points(self.fused(folder, sparse), self.options.stride_px)

    def fused(self, folder: Path, sparse: SparseModel) -> Iterator[tuple[PosedView, np.ndarray]]:
        """Yield each reference view with its dense points. Other views may repeat its points."""
        store, stride = self.work / "dense", self.options.stride_px
        references = find_references(sparse)
        paths: dict[str, Path] = {}
        tasks = []
        for images in references:
            matched = images[: 1 + MATCHED_NEIGHBOURS]
            states = [file_state(folder / image.view.name) for image in matched]
            path = store / f"{key(matched, states, stride, __version__)}.npz"
            paths[images[0].view.name] = path
            if load_arrays(path) is None:  # the file is missing or damaged
                tasks.append((path, matched))
        for old in store.glob("*.npz"):
            if old not in paths.values():
                old.unlink()
        work = partial(
            _depth_task,
            folder=folder.absolute(),
            points=sparse.points,
            stride_px=stride,
            reading=reading_options(),
        )
        workers, done = self._dense_workers(sparse), len(paths) - len(tasks)
        with progress(len(paths), "dense points", "image", self.quiet, done) as bar:
            for _ in map_in_processes(work, tasks, workers):
                bar.update()
        fuse = partial(_fuse_task, paths=paths, stride_px=stride)
        views = (limited_view(images[0].view) for images in references)
        fused = map_in_processes(fuse, references, workers)
        yield from zip(views, fused, strict=True)

    def _dense_workers(self, sparse: SparseModel) -> int:
        sizes = [limited_view(image.view).camera.size for image in sparse.images.values()]
        pixels = max(width * height for width, height in sizes)
        fused = pixels // self.options.stride_px**2
        needed = max(needed_memory(dense_pixel=pixels), needed_memory(fused_pixel=fused))
        fitting = max(1, int(available_memory() // needed))
        return min(self.workers or processor_count(), fitting)


def _depth_task(
    task: tuple[Path, list[RegisteredImage]],
    folder: Path,
    points: np.ndarray,
    stride_px: int,
    reading: ReadingOptions,
) -> None:
    path, images = task
    with read_with(reading):
        made = depth_map(folder, images, points, stride_px)
    save_arrays(path, {"depth": made}, compress=False)


def _fuse_task(
    images: list[RegisteredImage], paths: Mapping[str, Path], stride_px: int
) -> np.ndarray:
    images = [image for image in images if image.view.name in paths]  # some images have no map
    maps = [(load_arrays(paths[image.view.name]) or {})["depth"] for image in images]
    return fuse_depth_maps([limited_view(image.view) for image in images], maps, stride_px)
