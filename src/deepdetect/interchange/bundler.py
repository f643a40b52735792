"""Bundler: list.txt, Lowe's .key files, and matches.init.txt.

Snavely et al., "Photo tourism", 2006. Lowe's files have rows before columns, the centre of the
first pixel at (0, 0), sigma in pixels, and orientations in radians that grow counter-clockwise.

Bundler looks for matches of a pair under the lower number first, and passes over all others.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import numpy as np

from .._shared.atomic import atomic_path
from .._shared.errors import OptionError
from .._shared.options import suggest_keywords
from ..features.keypoints import Keypoints
from ..sfm.lens import Lens
from .collection import Collection, PairMatches, check_names, check_upright, sift_bytes
from .colmap import DEFAULT_SIZE_PX, orientations_of

NUMBERS_PER_LINE = 20
"""Of a descriptor, in Lowe's files."""


@suggest_keywords
def write_bundler(
    collection: Collection, output: str | Path, *, lenses: Mapping[str, Lens] = {}
) -> tuple[Path, ...]:
    """Write list.txt, a .key file for each photograph, and matches.init.txt.

    Args:
        collection: the photographs, whose keypoints have SIFT descriptors.
        output: folder.
        lenses: cameras; focal lengths that are known, and not only guessed, are in list.txt.

    Returns:
        The files, each of which appears whole, or not at all.

    Raises:
        OptionError: keypoints have no SIFT descriptors, which this format always has; a name has a
            blank, or does not end in .jpg, .pgm or .bmp; a photograph is turned by EXIF; or two
            would have one .key file.
        DeepDetectError: a file cannot be written.
    """
    folder = Path(output)
    for name, points in collection.keypoints.items():
        if sift_bytes(points) is None:
            raise OptionError(
                f"the keypoints of {name} have no SIFT descriptors, which .key files need: name "
                "the folder of the photographs as `images`"
            )
    check_names("bundler", collection.keypoints)
    check_upright("bundler", collection.photographs)
    keys: dict[str, str] = {}
    for name in collection.keypoints:
        key = str(PurePosixPath(name).with_suffix(".key"))
        if key in keys:
            raise OptionError(f"{keys[key]} and {name} would have the same {key}: rename one")
        keys[key] = name
    written = []
    for key, name in keys.items():
        with atomic_path(folder / key) as temporary:
            temporary.write_text(_key_text(collection.keypoints[name]), encoding="ascii")
        written.append(folder / key)
    lines = []
    for name in collection.keypoints:
        lens = lenses.get(name)
        known = lens is not None and lens.source != "estimated"
        lines.append(f"{name} 0 {lens.params[0]:.4f}" if lens and known else name)
    texts = {"list.txt": "".join(f"{line}\n" for line in lines)}
    if collection.matches:
        texts["matches.init.txt"] = "".join(
            f"{first} {second}\n{len(rows)}\n" + "".join(f"{a} {b}\n" for a, b in rows.tolist())
            for (first, second), rows in _numbered_matches(collection)
        )
    for file, text in texts.items():
        with atomic_path(folder / file) as temporary:
            temporary.write_text(text, encoding="utf-8")
        written.append(folder / file)
    return tuple(written)


def _numbered_matches(collection: Collection) -> list[tuple[tuple[int, int], np.ndarray]]:
    """Return the rows of each pair, the photograph with the lower number first."""
    numbers = {name: number for number, name in enumerate(collection.keypoints)}
    found: dict[tuple[int, int], PairMatches] = {}
    for (name0, name1), matches in collection.matches.items():
        first, second = numbers[name0], numbers[name1]
        rows, scores = matches.rows, matches.scores
        if first > second:
            first, second, rows = second, first, rows[:, ::-1]
        if (same := found.get((first, second))) is not None:  # the pair both ways round
            rows = np.concatenate([same.rows, rows])
            scores = np.concatenate([same.scores, scores])
        found[first, second] = PairMatches.one_to_one(rows, scores)
    return [(pair, matches.rows) for pair, matches in sorted(found.items())]


def _key_text(points: Keypoints) -> str:
    """Return Lowe's text file of keypoints with descriptors."""
    descriptors = sift_bytes(points)
    assert descriptors is not None
    sizes = np.full(len(points), DEFAULT_SIZE_PX) if points.sizes is None else points.sizes
    turned = -orientations_of(points)
    turned = np.arctan2(np.sin(turned), np.cos(turned))  # in [-pi, pi], as Lowe has it
    lines = [f"{len(points)} {descriptors.shape[1]}"]
    rows = zip(points.xy.tolist(), (sizes / 2).tolist(), turned.tolist(), strict=True)
    for ((x, y), scale, angle), descriptor in zip(rows, descriptors.tolist(), strict=True):
        lines.append(f"{y:.3f} {x:.3f} {scale:.3f} {angle:.4f}")
        lines += [
            " " + " ".join(map(str, descriptor[k : k + NUMBERS_PER_LINE]))
            for k in range(0, len(descriptor), NUMBERS_PER_LINE)
        ]
    return "\n".join(lines) + "\n"
