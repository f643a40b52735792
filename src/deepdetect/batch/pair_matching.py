"""Matching of many pairs of images, into a file in hloc's layout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from natsort import natsorted, ns

from .. import __version__
from .._shared.errors import InvalidFileError, OptionError, check_name, noted_failures
from .._shared.options import check_ranges, suggest_keywords
from .._shared.records import key
from ..features.keypoints import Keypoints
from ..features.match_filter import check_filter, require_suited
from ..features.matchers import MATCHERS_OF_NUMBERS
from ..geometry import GeometryOptions, estimate_geometry
from ..geometry.estimation import check_model
from ..matching.pipeline import match_features
from .extraction import read_keypoints
from .hdf5 import (
    SETTINGS,
    BatchReport,
    Group,
    Item,
    State,
    feature_names,
    fill_file,
    open_hdf5,
    state_of,
)
from .pair_list import Pair, following, list_pairs, pair_name, similar, write_pairs
from .similar_pairs import similar_pairs


@suggest_keywords
@dataclass(frozen=True)
class PairMatchingOptions:
    """How the features of two images are matched.

    Attributes:
        ratio: limit of Lowe's ratio test: the distance to the nearest neighbour must be below this
            fraction of the distance to the second-nearest. None: the default of `match_features`.
        mutual: keep only mutual nearest neighbours.
        filter_by: which nearest neighbours are matches: those that pass the ratio test ("ratio"),
            or that move as the matches around them do ("neighbours").
        matcher: name of the matcher: "auto", "exact", "patchmatch" or "flann".
        verify: keep only the inliers of a geometry that is estimated from the matches:
            "fundamental", "homography" or "auto". None keeps all matches.
        inlier_threshold: with `verify`, the largest error of an inlier in pixels.
        seed: seed of random choices.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    ratio: float | None = None
    mutual: bool = True
    filter_by: Literal["ratio", "neighbours"] = "ratio"
    matcher: str = "auto"
    verify: str | None = None
    inlier_threshold: float = GeometryOptions.inlier_threshold
    seed: int = 0

    def __post_init__(self) -> None:
        positive = "inlier_threshold", "ratio"
        check_ranges(self, positive=positive, not_negative=("seed",), fractions=("ratio",))
        check_filter(self.filter_by, self.ratio, self.mutual)
        check_name("matcher", self.matcher, MATCHERS_OF_NUMBERS)
        if self.verify == "essential":
            raise OptionError(
                "without cameras, `verify` must be 'fundamental', 'homography' or 'auto'"
            )
        check_model(self.verify or "auto", self.seed, GeometryOptions())


@suggest_keywords
def match_pairs(
    features: str | Path,
    pairs: str | Path | Sequence[Pair],
    path: str | Path,
    *,
    options: PairMatchingOptions = PairMatchingOptions(),
    engine: str = "processes",
    workers: int | None = None,
    overwrite: bool = False,
    quiet: bool = True,
) -> BatchReport:
    """Match the features of pairs of images into an HDF5 file in hloc's layout.

    Each pair has a group NAME0/NAME1, with "-" instead of each "/" in the names. If the first image
    has N0 keypoints, the group contains:

    - `matches0` (N0,) int32: for each keypoint of the first image, the index of its match among the
      keypoints of the second image, or -1 if it has no match.
    - `matching_scores0` (N0,) float32 in [0, 1]: 1 minus the distance ratio of Lowe's test or, with
      `filter_by="neighbours"`, the probability that the match is correct.

    If `pairs` is a word such as "exhaustive", the pairs are also listed in the file PATH.pairs.txt,
    which hloc needs.

    The same call continues an interrupted run: it skips pairs with unchanged features and adds new
    ones. The function starts processes, so a script must call it under
    `if __name__ == "__main__":`.

    Args:
        features: file written by `extract_features` or by hloc.
        pairs: "exhaustive" (all pairs), "sequential:10" (each image with the 10 that follow it by
            name), "similar:20" or "similar" (each image with the 20 most similar ones, by VLAD of
            their best 512 keypoints), a list of pairs of names, or a text file with a pair on each
            line. A pair listed twice, in either order, counts once. Pairs of an earlier run stay in
            the file, even if new images change which images are most similar.
        path: the HDF5 file to write.
        options: how pairs are matched.
        engine: "processes" for processes on this machine, or "ray" for a Ray cluster.
        workers: number of processes; default: one per processor.
        overwrite: replace an existing file instead of continuing it.
        quiet: show no progress bar.

    Returns:
        The number of matches of each pair, and `failures`: pairs without features, or with
        descriptors of different types, which do not stop the others.

    Raises:
        OptionError: an option is unknown, a pair is wrong, or the file has other settings.
        MissingExtraError: h5py, or what the engine needs, is not installed.
        DeepDetectError: a file cannot be read or written.

    Example:
        >>> if __name__ == "__main__":  # doctest: +SKIP
        ...     match_pairs("features.h5", "pairs.txt", "matches.h5").check()
    """
    source = Path(features).absolute()
    if not (alike := similar(pairs)):
        list_pairs(pairs, ())  # raises an error for wrong pairs before long work
    if source == Path(path).absolute():
        raise OptionError(f"{path} holds the features: write the matches to another file with -o")
    if options.filter_by == "neighbours" and (first := first_keypoints(source)):
        require_suited(first)
    with open_hdf5(source) as file:
        names = natsorted(feature_names(file), alg=ns.PATH)
    if alike:
        listed, unlike = similar_pairs(source, names, alike, options.seed, quiet)
    else:
        listed, unlike = list_pairs(pairs, names), []
    wanted, failures, gone, made_with = _find_pairs(source, listed)
    report = fill_file(
        path,
        {**vars(options), "features": made_with, "version": __version__},
        wanted,
        partial(_match_pairs, features=source, options=options),
        of="pairs",
        others_stay=lambda name: not overwrite and name not in gone,
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=quiet,
    )
    if alike or following(pairs):
        write_pairs(Path(f"{path}.pairs.txt"), listed)
    return replace(report, failures=(*unlike, *failures, *report.failures))


def first_keypoints(features: Path) -> Keypoints | None:
    """Return a file's first undamaged keypoints, or None; all its keypoints are of one kind."""
    with open_hdf5(features) as file:
        for name in feature_names(file):
            with suppress(InvalidFileError):
                return read_keypoints(file, name)
    return None


def _find_pairs(
    features: Path, pairs: Sequence[Pair]
) -> tuple[dict[Pair, dict[str, State]], list[str], set[str], str]:
    """Find out which pairs can be matched with the features in a file.

    Returns, for each such pair, the two groups that may store its matches, with the states of its
    features; a sentence on each other pair; the groups of pairs without features, which are
    obsolete; and a digest of the settings of the features.
    """
    wanted, taken = dict[Pair, dict[str, State]](), dict[str, Pair]()
    failures, gone = list[str](), set[str]()
    with open_hdf5(features) as file:
        settings = key(str(file.attrs.get(SETTINGS)))
        states = {name: _state(file, name) for name in {name for pair in pairs for name in pair}}
        for pair in pairs:
            state0, state1 = states[pair[0]], states[pair[1]]
            name, reversed_name = pair_name(*pair), pair_name(*pair[::-1])
            if state0 is None or state1 is None:
                lacking = pair[0] if state0 is None else pair[1]
                failures.append(f"{' '.join(pair)}: {features.name} has no features of {lacking}")
                gone |= {name, reversed_name}
            elif taken.setdefault(name, pair) != pair:
                failures.append(
                    f"{' '.join(pair)}: the pair {' '.join(taken[name])} has the same group name: "
                    "rename an image"
                )
            else:
                wanted[pair] = {name: state0 + state1, reversed_name: state1 + state0}
    return dict(sorted(wanted.items())), failures, gone - taken.keys(), settings


def _state(file: Any, name: str) -> State | None:
    """Return numbers that change if an image's features change, or None if it has no features."""
    try:
        group = file[name]
        if state := state_of(group):
            return state
        # Files of other programs store no state, so the features themselves are compared.
        digest = key(group["keypoints"][()], group["descriptors"][()])
    except (KeyError, TypeError, ValueError, IndexError):
        return None
    return (int(digest[:15], 16),)


def _match_pairs(
    pairs: Sequence[Item],
    counts: dict[Pair, int],
    failures: list[str],
    features: Path,
    options: PairMatchingOptions,
) -> Iterator[Group]:
    with open_hdf5(features) as file:
        first: tuple[str, Keypoints] | None = None  # reused: pairs are sorted by first image
        for (name0, name1), state in pairs:
            with noted_failures(f"{name0} {name1}", failures):
                if first is None or first[0] != name0:
                    first = name0, read_keypoints(file, name0)
                features0, features1 = first[1], read_keypoints(file, name1)
                both = features0.descriptors, features1.descriptors
                if len({np.asarray(each).shape[-1:] for each in both}) > 1:
                    raise InvalidFileError(
                        "their descriptors are of different types: extract both again"
                    )
                rows, scores = _match(features0, features1, options)
                counts[name0, name1] = len(rows)
                yield match_group((name0, name1), len(features0), rows, scores, state)


def match_group(
    pair: Pair, count: int, rows: np.ndarray, scores: np.ndarray, state: State = ()
) -> Group:
    """Return the group of a pair's matches in hloc's layout.

    `count` is the number of keypoints of the first image. `rows` (K, 2) are the indices of matching
    keypoints in the first and second image, and `scores` (K,) are the scores of the matches.
    """
    matches0, scores0 = np.full(count, -1, np.int32), np.zeros(count, np.float32)
    matches0[rows[:, 0]], scores0[rows[:, 0]] = rows[:, 1], scores
    return Group(pair_name(*pair), {"matches0": matches0, "matching_scores0": scores0}, state)


def _match(
    features0: Keypoints, features1: Keypoints, options: PairMatchingOptions
) -> tuple[np.ndarray, np.ndarray]:
    taken = "matcher", "filter_by", "ratio", "mutual", "seed"
    found = match_features(features0, features1, **{name: getattr(options, name) for name in taken})
    kept, how = found.inliers, GeometryOptions(inlier_threshold=options.inlier_threshold)
    if options.verify is not None:
        model, seed = options.verify, options.seed
        kept = estimate_geometry(found, model=model, seed=seed, options=how).inliers
    return np.column_stack([found.indices0, found.indices1])[kept], found.scores[kept]
