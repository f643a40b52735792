"""The stages of a reconstruction of many photographs, each of which is done once.

Features and matches are in the HDF5 files of `batch`. Mapping and dense points have a digest of all
that they depend on: what a run finds with the right digest it does not make again.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from .._shared.atomic import atomic_path
from .._shared.errors import ImageError, MissingImageError, OptionError, ReconstructionError
from .._shared.memory import available_memory, needed_memory
from .._shared.parallel import map_in_processes, processor_count
from .._shared.progress import progress
from ..batch.extraction import extract_features
from ..batch.pair_list import pair_name
from ..batch.pair_matching import match_pairs
from ..batch.hdf5 import open_hdf5
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.selection import SelectionOptions
from ..io.image import find_images
from .colmap import import_pycolmap
from .database import DatabaseImage, write_database
from .dense import Reference, dense_points, find_references, limited_view
from .fusion import DenseOptions, DensePoints, merge_dense_points
from .lens import Lens
from .mapping import (
    SparseModel,
    adjust,
    map_photographs,
    normalise_model,
    verify_pairs,
    write_sparse_model,
)
from .options import MultiViewOptions
from .pair_selection import Pair, all_pairs, sequential_pairs, similar_pairs, vlad_vectors

WORK = "work"
"""Folder of what the stages made, within that of the results."""

LINKS = ".images"
"""Folder of links to listed photographs, within `WORK`. It is hidden, so that they are no further
photographs of a folder that holds the results."""


@dataclass(frozen=True, eq=False)
class PhotographFeatures:
    """What is known of photographs.

    Attributes:
        sizes, keypoints: (width, height) in pixels and number of keypoints of those that could be
            read, by name.
        failures: a sentence on each of the others.
    """

    sizes: dict[str, tuple[int, int]]
    keypoints: dict[str, int]
    failures: dict[str, str]


def check_photographs(images: str | Path | Sequence[str | Path]) -> dict[str, Path]:
    """Return the photographs below a folder, or of a list, by name.

    Raises:
        ImageError: the folder is missing or holds no image, or a file is missing.
        OptionError: two files of a list have one name.
    """
    if isinstance(images, (str, Path)):
        folder = Path(images)
        return {path.relative_to(folder).as_posix(): path for path in find_images(folder)}
    paths = [Path(path) for path in images]
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise MissingImageError(f"there is no file {missing[0]}: check the path")
    taken: dict[str, Path] = {}
    for path in paths:
        if taken.setdefault(path.name, path).resolve() != path.resolve():
            raise OptionError(f"{taken[path.name]} and {path} have one name: rename one of them")
    return taken


class Stages:
    """The stages of a reconstruction; what each makes is kept in a folder.

    Args:
        output: folder of the results.
        options: of all stages.
        workers: number of processes; None: one per processor.
        quiet: show no progress bars.
    """

    def __init__(
        self, output: Path, options: MultiViewOptions, workers: int | None, quiet: bool
    ) -> None:
        self.output, self.work = output, output / WORK
        self.options, self.workers, self.quiet = options, workers, quiet

    def folder_of(self, images: str | Path | Sequence[str | Path]) -> Path:
        """Return the folder of the photographs: for a list, one with links to them."""
        if isinstance(images, (str, Path)):
            folder = Path(images)
            if self.output.resolve() == folder.resolve():
                raise OptionError(f"{folder} holds the photographs: give another folder with -o")
            return folder
        taken = check_photographs(images)
        folder = self.work / LINKS
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.iterdir():
            if old.name not in taken:
                old.unlink()
        for name, path in taken.items():
            _link(path, folder / name)
        return folder

    def extract(
        self,
        folder: Path,
        detector: DeepDetect | PointDetector,
        selection: SelectionOptions | None = None,
    ) -> PhotographFeatures:
        """Find and describe the keypoints of all photographs below a folder."""
        report = extract_features(
            folder,
            self.work / "features.h5",
            detector,
            selection=selection,
            workers=self.workers,
            quiet=self.quiet,
        )
        sizes, keypoints, failures = {}, {}, {}
        names = [path.relative_to(folder).as_posix() for path in find_images(folder)]
        if not (self.work / "features.h5").exists():
            raise ReconstructionError("no photograph can be read: " + "; ".join(report.failures))
        with open_hdf5(self.work / "features.h5") as file:
            for name in names:
                own = (f"{folder.absolute() / name} ", f"{name}: ")
                sentence = [text for text in report.failures if text.startswith(own)]
                if not sentence and name in file:  # 1.jpg is in the sentence on 11.jpg, too
                    width, height = file[name]["image_size"][()]
                    sizes[name] = int(width), int(height)
                    keypoints[name] = len(file[name]["keypoints"])
                else:
                    sentence += [text for text in report.failures if name in text]
                    failures[name] = (sentence or ["it could not be read"])[0]
        return PhotographFeatures(sizes, keypoints, failures)

    def choose_pairs(self, names: Sequence[str]) -> list[Pair]:
        """Choose which photographs are matched with each other."""
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

    def match(self, pairs: Sequence[Pair]) -> dict[Pair, np.ndarray]:
        """Match pairs; return (K, 2) rows of keypoints of each."""
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

    def map(
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
                self.output / "database.db",
                folder,
                space,
                known,
                options,
                # Those of an attempt that is given up are counted again in the next.
                lambda count: bar.update(min(count, len(images) - bar.n)),
            )
        shutil.rmtree(space, ignore_errors=True)
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

    def dense(self, folder: Path, sparse: SparseModel) -> DensePoints:
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
        fitting = max(1, int(available_memory() // needed_memory(dense_pixel=pixels)))
        return min(self.workers or processor_count(), fitting)


def _link(source: Path, place: Path) -> None:
    """Make a file appear at a place: a link where the system has them, else a copy."""
    if place.exists() and place.samefile(source):
        return
    place.unlink(missing_ok=True)
    try:
        place.symlink_to(source.resolve())
    except OSError:
        shutil.copy2(source, place)


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
