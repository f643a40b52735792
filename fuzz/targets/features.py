"""Files of features that many pairs are matched from, and lists of pairs."""

from __future__ import annotations

import tempfile
from pathlib import Path

import h5py
import numpy as np

from deepdetect.batch.extraction import feature_group
from deepdetect.batch.hdf5 import write_groups
from deepdetect.batch.pair_matching import match_pairs
from deepdetect.features.keypoints import Keypoints

from ..case import Target, expect, prepared
from ..mutations import mutate

NAMES = ("a.jpg", "b.jpg", "c.jpg")
PAIRS = "a.jpg b.jpg\na.jpg c.jpg\n"


@prepared
def features_file() -> bytes:
    """Return an HDF5 file of features."""
    generator = np.random.default_rng(1)
    descriptors = generator.integers(0, 90, (30, 128)).astype(np.uint8)
    groups = [
        feature_group(
            name,
            Keypoints(
                generator.uniform(0, 60, (30, 2)),
                generator.uniform(0, 1, 30),
                (64, 64),
                descriptors=descriptors,
            ),
            (1,),
        )
        for name in NAMES
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.h5"
        write_groups(path, groups)
        return path.read_bytes()


def features(generator: np.random.Generator, folder: Path) -> None:
    """Match the pairs of a damaged file of features."""
    path = folder / "features.h5"
    path.write_bytes(mutate(features_file(), generator))
    _match(path, PAIRS.encode(), folder)


def pairs(generator: np.random.Generator, folder: Path) -> None:
    """Match a damaged list of pairs."""
    path = folder / "features.h5"
    path.write_bytes(features_file())
    _match(path, mutate(PAIRS.encode(), generator), folder)


def continued(generator: np.random.Generator, folder: Path) -> None:
    """Go on with a file of matches that was damaged meanwhile."""
    path, output = folder / "features.h5", folder / "matches.h5"
    path.write_bytes(features_file())
    _match(path, PAIRS.splitlines()[0].encode(), folder)
    output.write_bytes(mutate(output.read_bytes(), generator))
    _match(path, PAIRS.encode(), folder)


def _match(path: Path, listed: bytes, folder: Path) -> None:
    """Match, and check what comes of it; what cannot be matched is among the failures."""
    (folder / "pairs.txt").write_bytes(listed)
    report = match_pairs(path, folder / "pairs.txt", folder / "matches.h5", workers=1)
    report.check()
    with h5py.File(folder / "matches.h5") as file:
        for pair in report.counts:
            group = file["/".join(pair)]
            matches, scores = group["matches0"][()], group["matching_scores0"][()]
            expect(matches.dtype == np.int32 and matches.min() >= -1, "rows that cannot be")
            expect(np.isfinite(scores).all(), "scores are not finite")


TARGETS = (
    Target("features", "files of features (HDF5), match-many", features, 800, 100),
    Target("pairs", "lists of pairs, match-many", pairs, 300, 100),
    Target("matches", "files of matches (HDF5), match-many again", continued, 300, 100),
)
