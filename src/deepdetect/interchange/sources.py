"""Collections from a folder of images, or from keypoints and matches in files."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .._shared.errors import InvalidFileError, OptionError
from .._shared.options import suggest_keywords
from ..batch.extraction import extract_features, read_keypoints
from ..batch.hdf5 import feature_names, import_h5py, open_hdf5
from ..batch.pair_list import Pair, list_pairs
from ..batch.pair_matching import match_pairs
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.keypoints import Keypoints
from ..io.image import find_images
from ..io.tables import load_keypoints, load_matches
from .collection import Collection, PairMatches

MAX_ALL_PAIRS = 50
"""`match_folder` without `pairs` matches all pairs of up to this many images. Chosen by hand."""

MATCHES_SUFFIX = "_matches"
"""The names of NPZ files written by `deepdetect match` end with this, before the suffix .npz."""


@suggest_keywords
def read_collection(
    files: Sequence[str | Path],
    *,
    matches: str | Path | None = None,
    images: str | Path | None = None,
) -> Collection:
    """Read saved keypoints and matches.

    Args:
        files: one HDF5 file written by `deepdetect extract` or hloc; or npz files written by
            `deepdetect detect` (STEM.npz) and `deepdetect match` (STEM0_STEM1_matches.npz).
        matches: HDF5 file written by `deepdetect match-many` or hloc.
        images: folder of the images, in which the image of each npz file is looked up by its stem.

    Returns: The collection. Matches from npz files are only the inliers of the geometry. They link
        keypoints, not refined positions, so that matches of several pairs form tracks.

    Raises:
        DeepDetectError: a file is missing or of another kind, or the names of images do not agree.
        MissingExtraError: h5py is not installed.
    """
    paths = [Path(path) for path in files]
    folder = None if images is None else Path(images)
    archives = [path for path in paths if path.suffix.lower() == ".npz"]
    if not paths or (archives and len(archives) < len(paths)) or (not archives and len(paths) > 1):
        raise OptionError("give one HDF5 file of features, or npz files, or a folder of images")
    if archives:
        if matches is not None:
            raise OptionError("npz files of matches belong to the `files`: leave out `matches`")
        return _read_archives(archives, folder)
    keypoints = read_features_file(paths[0])
    found = {} if matches is None else read_matches_file(Path(matches), keypoints)
    if folder is not None and not any((folder / name).is_file() for name in keypoints):
        raise OptionError(
            f"{folder} has none of the images of {paths[0]}, such as {next(iter(keypoints))}: give "
            "the folder from which the features were extracted as `images`"
        )
    return Collection(keypoints, found, folder)


def read_features_file(path: Path) -> dict[str, Keypoints]:
    """Read all features of an HDF5 file in hloc's layout; return them by image name."""
    with open_hdf5(path) as file:
        found = {name: read_keypoints(file, name) for name in sorted(feature_names(file))}
    if not found:
        raise InvalidFileError(f"{path} has no features: give a file written by deepdetect extract")
    return found


def read_matches_file(path: Path, keypoints: Mapping[str, Keypoints]) -> dict[Pair, PairMatches]:
    """Read all matches of these keypoints from an HDF5 file in hloc's layout.

    In the file, the names of images have "-" instead of "/".

    Raises:
        DeepDetectError: the file is missing, damaged or without matches, its names are ambiguous,
            or its matches belong to other keypoints.
    """
    known: dict[str, list[str]] = {}
    for name in keypoints:
        known.setdefault(name.replace("/", "-"), []).append(name)
    h5py = import_h5py()
    found: dict[Pair, PairMatches] = {}
    with open_hdf5(path) as file:
        for first, seconds in file.items():
            for second, group in seconds.items() if isinstance(seconds, h5py.Group) else ():
                if not isinstance(group, h5py.Group) or "matches0" not in group:
                    continue
                pair = []
                for written in (first, second):
                    if len(known.get(written, ())) != 1:
                        reason = "several" if written in known else "none"
                        raise InvalidFileError(
                            f"{path} has matches of {written}, a name that fits {reason} of the "
                            "images with features: give the features that were matched"
                        )
                    pair.append(known[written][0])
                rows1 = np.asarray(group["matches0"][()], np.int64)
                count = len(keypoints[pair[0]])
                if rows1.shape != (count,):
                    raise InvalidFileError(
                        f"{path} has matches of {rows1.size} keypoints of {pair[0]}, but it has "
                        f"{count}: give the features that were matched"
                    )
                rows0 = np.flatnonzero(rows1 >= 0)
                scores = group.get("matching_scores0")
                kept = np.ones(len(rows0)) if scores is None else scores[()][rows0]
                rows = np.column_stack([rows0, rows1[rows0]])
                _add_matches(found, (pair[0], pair[1]), PairMatches.one_to_one(rows, kept))
    if not found:
        raise InvalidFileError(
            f"{path} has no matches: give a file written by deepdetect match-many"
        )
    return found


def _add_matches(found: dict[Pair, PairMatches], pair: Pair, matches: PairMatches) -> None:
    """Add the matches of a pair to `found`; merge them with those of the reversed pair, if any."""
    other = found.get(pair[::-1])
    if other is None:
        found[pair] = matches
        return
    rows = np.concatenate([other.rows, matches.rows[:, ::-1]])
    scores = np.concatenate([other.scores, matches.scores])
    found[pair[::-1]] = PairMatches.one_to_one(rows, scores)


def _read_archives(paths: Sequence[Path], folder: Path | None) -> Collection:
    names = _names_by_stem(folder)
    keypoints: dict[str, Keypoints] = {}
    matches: dict[Pair, PairMatches] = {}
    for path in sorted(paths, key=lambda path: path.stem.endswith(MATCHES_SUFFIX)):
        if not path.stem.endswith(MATCHES_SUFFIX):
            name = path.stem if names is None else _name_of(path, names)
            if name in keypoints:
                raise OptionError(
                    f"two files belong to {name}: give the folder of the images as `images`"
                )
            keypoints[name] = load_keypoints(path)
            continue
        loaded = load_matches(path)
        pair = _pair_of_stem(path.stem.removesuffix(MATCHES_SUFFIX), names, path)
        for name, own in zip(pair, (loaded.keypoints0, loaded.keypoints1), strict=True):
            before = keypoints.setdefault(name, own)
            if not (np.array_equal(before.xy, own.xy) and before.image_size == own.image_size):
                raise InvalidFileError(
                    f"{path} has other keypoints of {name} than the other files: write all "
                    "files with the same options"
                )
        kept = loaded.inliers
        rows = np.column_stack([loaded.indices0[kept], loaded.indices1[kept]])
        _add_matches(matches, pair, PairMatches.one_to_one(rows, loaded.scores[kept]))
    return Collection(keypoints, matches, folder)


def _names_by_stem(folder: Path | None) -> dict[str, str] | None:
    """Map the names that an npz file may use for an image to the image's name.

    These names are the image's path below the folder, with or without suffix, and its stem. Names
    that fit several images are left out. Without a folder, the result is None.
    """
    if folder is None:
        return None
    names: dict[str, set[str]] = {}
    for path in find_images(folder):
        own = path.relative_to(folder)
        for key in (own.as_posix(), own.with_suffix("").as_posix(), path.stem):
            names.setdefault(key, set()).add(own.as_posix())
    return {key: name for key, (name, *others) in names.items() if not others}


def _name_of(path: Path, names: Mapping[str, str]) -> str:
    """Return the name in `names` whose key is the longest trailing part of an npz file's path."""
    parts = path.with_suffix("").parts
    for first in range(len(parts)):
        if (key := "/".join(parts[first:])) in names:
            return names[key]
    raise OptionError(
        f"{path} belongs to no image in the folder `images`, or to several: give it the name and "
        "subfolder of the image"
    )


def _pair_of_stem(stem: str, names: Mapping[str, str] | None, path: Path) -> Pair:
    parts = stem.split("_")
    joined = [("_".join(parts[:k]), "_".join(parts[k:])) for k in range(1, len(parts))]
    if names is not None:
        joined = [(names[a], names[b]) for a, b in joined if a in names and b in names]
    if len(joined) != 1:
        raise OptionError(
            f"it is unclear which two images {path} is for: give their folder as `images`"
            if names is None
            else f"{path} fits no pair of images below `images`, or more than one: "
            "give another folder"
        )
    return joined[0]


@suggest_keywords
def match_folder(
    folder: str | Path,
    detector: DeepDetect | PointDetector | None = None,
    *,
    pairs: str | Path | Sequence[Pair] | None = None,
    workers: int | None = None,
    quiet: bool = True,
) -> Collection:
    """Detect and match the keypoints of all images below a folder.

    For large collections, use `extract_features` and `match_pairs`, which keep their results. The
    function starts processes, so a script must call it under `if __name__ == "__main__":`.

    Args:
        folder: folder of the images.
        detector: a detector as in `extract_features`.
        pairs: pairs as in `match_pairs`; None: all pairs, if there are at most 50 images.
        workers: number of processes; default: one per processor.
        quiet: show no progress bars.

    Returns:
        The collection. Its `failures` list the images and pairs that could not be processed.

    Raises:
        ImageError: the folder is missing, or holds no image.
        OptionError: an option is out of its range, or there are too many images for all pairs.
        BatchError: no image can be read.
        MissingExtraError: h5py is not installed.
    """
    root = Path(folder)
    names = [path.relative_to(root).as_posix() for path in find_images(root)]
    if pairs is None and len(names) > MAX_ALL_PAIRS:
        raise OptionError(
            f"all pairs of {len(names)} images would take long: give `pairs`, such as "
            "'sequential:10'"
        )
    pairs = "exhaustive" if pairs is None else pairs
    list_pairs(pairs, ())  # wrong pairs raise an error before the long work
    with tempfile.TemporaryDirectory(prefix="deepdetect-") as temporary:
        features, found = Path(temporary, "features.h5"), Path(temporary, "matches.h5")
        extracted = extract_features(root, features, detector, workers=workers, quiet=quiet)
        if not extracted.counts:
            extracted.check()
        keypoints = read_features_file(features)
        unread = set(names) - keypoints.keys()
        # An unreadable image counts as one failure; its pairs do not count as further failures.
        wanted = list_pairs(pairs, [name for name in names if name in keypoints])
        wanted = [pair for pair in wanted if unread.isdisjoint(pair)]
        matched = match_pairs(features, wanted, found, workers=workers, quiet=quiet)
        matches = read_matches_file(found, keypoints) if matched.counts else {}
        return Collection(keypoints, matches, root, (*extracted.failures, *matched.failures))
