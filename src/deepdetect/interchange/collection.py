"""Images with their keypoints and matches, from which the files of other programs are written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from .._shared.errors import ImageError, OptionError
from .._shared.progress import progress
from ..batch.pair_list import Pair
from ..features.keypoints import Keypoints
from ..features.sift import describe_keypoints
from ..io.image import UPRIGHT, load_image, luma, one_range, orientation_of
from ..io.image_file import open_image


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Matches of two images.

    Attributes:
        rows: (K, 2) int32 indices of matching keypoints in the first and the second image. Each
            keypoint has at most one match.
        scores: (K,) float32 in [0, 1], higher is better.
    """

    rows: np.ndarray
    scores: np.ndarray

    @classmethod
    def one_to_one(cls, rows: np.ndarray, scores: np.ndarray) -> PairMatches:
        """Keep only the best match of each keypoint; leave out rows with an index below 0.

        Example:
            >>> PairMatches.one_to_one([[0, 5], [1, 5], [2, -1], [3, 0]], [.2, .9, 1, .5]).rows
            array([[1, 5],
                   [3, 0]], dtype=int32)
        """
        rows = np.asarray(rows, np.int32).reshape(-1, 2)
        scores = np.asarray(scores, np.float32)
        kept = np.flatnonzero((rows >= 0).all(axis=1))
        for side in (0, 1):
            best_first = kept[np.lexsort((kept, -scores[kept]))]
            _, first = np.unique(rows[best_first, side], return_index=True)
            kept = np.sort(best_first[first])
        return cls(rows[kept], scores[kept])

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True, eq=False)
class Collection:
    """Images with their keypoints and matches.

    Attributes:
        keypoints: keypoints by image name, which is the image's path below `folder`, with "/".
        matches: matches by pair of image names.
        folder: folder of the images, if known.
        failures: a sentence on each image or pair that could not be processed.

    Raises:
        OptionError: a match refers to an image or a keypoint that does not exist.
    """

    keypoints: Mapping[str, Keypoints]
    matches: Mapping[Pair, PairMatches] = field(default_factory=dict)
    folder: Path | None = None
    failures: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for pair, found in self.matches.items():
            for side, name in enumerate(pair):
                if name not in self.keypoints:
                    raise OptionError(
                        f"the matches of {pair[0]} and {pair[1]} need the keypoints of {name}, "
                        "which are missing: also give the features of that image"
                    )
                most = int(found.rows[:, side].max(initial=-1))
                if most >= len(self.keypoints[name]):
                    raise OptionError(
                        f"the matches of {pair[0]} and {pair[1]} refer to keypoint {most} of "
                        f"{name}, which has only {len(self.keypoints[name])}: give the features "
                        "that were matched"
                    )

    def path(self, name: str) -> Path | None:
        """Return the path of an image, or None if the folder is unknown or the file missing."""
        path = None if self.folder is None else self.folder / name
        return path if path is not None and path.is_file() else None


def describe_collection(collection: Collection, quiet: bool = True) -> Collection:
    """Add RootSIFT descriptors to keypoints without descriptors, if their image is available.

    Keypoints without sizes and angles are described upright, with a diameter of 3 pixels.

    Args:
        collection: the collection, which is not changed.
        quiet: show no progress bar.

    Raises:
        ImageError: the size of an image differs from that of its keypoints.
    """
    described = dict(collection.keypoints)
    left = {
        name: path
        for name, points in described.items()
        if points.descriptors is None and (path := collection.path(name)) is not None
    }
    with one_range([*left.values()]), progress(len(left), "describing", "image", quiet) as bar:
        for name, path in left.items():
            points, gray = described[name], luma(load_image(path))
            if gray.shape[::-1] != points.image_size:
                raise ImageError(
                    f"{path} has {gray.shape[1]}x{gray.shape[0]} pixels, but its keypoints are of "
                    f"an image of {points.image_size[0]}x{points.image_size[1]}: give the folder "
                    "of the images in which they were found"
                )
            described[name] = describe_keypoints(gray, points)
            bar.update()
    return replace(collection, keypoints=described)


def check_names(names: Iterable[str]) -> None:
    """Raise an OptionError if a name contains blanks, because blanks separate names in a list."""
    for name in names:
        if len(name.split()) != 1:
            raise OptionError(f"this format separates image names by blanks: rename {name!r}")


def check_upright(paths: Iterable[Path]) -> None:
    """Raise an OptionError for an image with an EXIF rotation, because hloc ignores EXIF."""
    for path in paths:
        try:
            with open_image(path) as image:
                turned = orientation_of(image) in UPRIGHT
        except ImageError:
            continue
        if turned:
            raise OptionError(
                f"{path} is rotated by its EXIF orientation, which hloc ignores: save it upright, "
                "without that tag (mogrify -auto-orient)"
            )
