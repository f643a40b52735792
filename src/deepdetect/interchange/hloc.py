"""Files of hloc: features, matches and pairs, in float32 and int32.

hloc uses the pixel coordinates of DeepDetect, and itself adds the half pixel that COLMAP needs.
"""

from __future__ import annotations

from pathlib import Path

from .._shared.errors import OptionError
from ..batch.extraction import feature_group
from ..batch.hdf5 import write_groups
from ..batch.pair_list import pair_name, write_pairs
from ..batch.pair_matching import match_group
from .collection import Collection, check_names, check_upright

FILES = ("features.h5", "matches.h5", "pairs.txt")


def write_hloc(collection: Collection, output: str | Path) -> tuple[Path, ...]:
    """Write features.h5 (keypoints, scores and descriptors), matches.h5 and pairs.txt.

    The three files are arguments of `hloc.reconstruction.main`. Each file is written atomically.
    The descriptors of an image have the shape (D, N).

    Args:
        collection: the images, whose descriptors hloc needs for matching, but not for mapping.
        output: folder for the files.

    Returns:
        The paths of the files. Without matches, matches.h5 and pairs.txt are not written.

    Raises:
        OptionError: two pairs would have the same group name, a name in the list of pairs has a
            blank, or an image is rotated by EXIF.
        DeepDetectError: a file cannot be written.
        MissingExtraError: h5py is not installed.
    """
    check_names(name for pair in collection.matches for name in pair)
    check_upright(path for name in collection.keypoints if (path := collection.path(name)))
    features, matches, pairs = (Path(output) / name for name in FILES)

    taken: dict[str, tuple[str, str]] = {}
    for pair in collection.matches:
        other = taken.setdefault(pair_name(*pair), pair)
        if other != pair:
            raise OptionError(
                f"the pairs {' '.join(pair)} and {' '.join(other)} have the same group name: "
                "rename an image"
            )
    keypoints = collection.keypoints
    write_groups(features, (feature_group(name, points) for name, points in keypoints.items()))
    if not collection.matches:
        return (features,)
    groups = (
        match_group(pair, len(keypoints[pair[0]]), found.rows, found.scores)
        for pair, found in collection.matches.items()
    )
    write_groups(matches, groups)
    write_pairs(pairs, [*collection.matches])
    return features, matches, pairs
