"""Images with their keypoints and matches: what all formats are written from."""

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
from ..io.image import UPRIGHT, load_image, luma, orientation_of
from ..io.image_file import open_image


@dataclass(frozen=True, eq=False)
class PairMatches:
    """Matches of two images.

    Attributes:
        rows: (K, 2) int32 keypoints of the first and of the second; each at most once.
        scores: (K,) float32 in [0, 1], higher is better.
    """

    rows: np.ndarray
    scores: np.ndarray

    @classmethod
    def one_to_one(cls, rows: np.ndarray, scores: np.ndarray) -> PairMatches:
        """Keep the best match of each keypoint; rows below 0 are no keypoints.

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
        keypoints: by the name of the image: its path below their folder, with "/".
        matches: by the names of two images.
        folder: of the images, where it is known.
        failures: a sentence on each image or pair that could not be worked on.

    Raises:
        OptionError: a match is of an image or a keypoint that is not there.
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
                        "which are not there: give its features, too"
                    )
                most = int(found.rows[:, side].max(initial=-1))
                if most >= len(self.keypoints[name]):
                    raise OptionError(
                        f"the matches of {pair[0]} and {pair[1]} name keypoint {most} of {name}, "
                        f"which has {len(self.keypoints[name])}: they are of other features"
                    )

    def path(self, name: str) -> Path | None:
        """Return the file of an image, or None where it is not known."""
        path = None if self.folder is None else self.folder / name
        return path if path is not None and path.is_file() else None


def describe_collection(collection: Collection, quiet: bool = True) -> Collection:
    """Return a collection whose keypoints have RootSIFT descriptors, as far as images allow.

    Those without sizes and angles are described upright, with a diameter of 3 pixels.

    Args:
        collection: whose images without descriptors are read.
        quiet: show no progress bar.

    Raises:
        ImageError: an image has another size than its keypoints.
    """
    described = dict(collection.keypoints)
    left = [name for name, points in described.items() if points.descriptors is None]
    left = [name for name in left if collection.path(name) is not None]
    with progress(len(left), "describing", "image", quiet) as bar:
        for name in left:
            points, path = described[name], collection.path(name)
            gray = luma(load_image(path))
            if gray.shape[::-1] != points.image_size:
                raise ImageError(
                    f"{path} has {gray.shape[1]}x{gray.shape[0]} pixels, its keypoints are of an "
                    f"image of {points.image_size[0]}x{points.image_size[1]}: name the folder of "
                    "the images that they were found in"
                )
            described[name] = describe_keypoints(gray, points)
            bar.update()
    return replace(collection, keypoints=described)


def check_names(names: Iterable[str]) -> None:
    """Refuse names with blanks, which a list of names with blanks between them cannot hold."""
    for name in names:
        if len(name.split()) != 1:
            raise OptionError(f"lists of this format separate names by blanks: rename {name!r}")


def check_upright(paths: Iterable[Path]) -> None:
    """Refuse images that EXIF turns, for readers that take the size from the file as it is stored.

    Those that cannot be read are not checked.
    """
    for path in paths:
        try:
            with open_image(path) as image:
                turned = orientation_of(image) in UPRIGHT
        except ImageError:
            continue
        if turned:
            raise OptionError(
                f"{path} is turned by its EXIF orientation, which hloc does not do: save it "
                "upright, without that tag (mogrify -auto-orient)"
            )
