"""Training pairs of the matcher: keypoints of two images, and which of them show the same place.

There are three kinds of pairs. Two synthetic views of one photograph have a known geometry. Two
photographs of a fixed camera show one view in another light, weather or season; each is seen from a
random viewpoint. Two photographs of one place from two viewpoints are matched by `match_images`: if
its confidence is high, its dense matches tell where keypoints lie in the other image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from deepdetect import match_images
from deepdetect._shared.errors import DeepDetectError, OptionError
from deepdetect._shared.machine import map_in_processes
from deepdetect._shared.opencv import cv2
from deepdetect._shared.progress import progress
from deepdetect._shared.records import load_arrays, save_arrays
from deepdetect.detector.point_detector import PointDetector
from deepdetect.features.keypoints import Keypoints
from deepdetect.geometry.images import downscale
from deepdetect.geometry.transforms import transform_points
from deepdetect.io.image import find_images, load_image

from ..descriptor.views import photograph_view
from ..match_filter import UNRELATED
from ..scenes import correspond, draw_layers, draw_until_seen, render_layers
from ..synthetic import WHITE, happens, rotation, scaled_along, view_homography
from .inputs import attention_inputs

KEYPOINTS, MIN_KEYPOINTS = 1024, 80
"""Images have at most KEYPOINTS and at least MIN_KEYPOINTS keypoints. Chosen by hand."""

SIDE_PX, MAX_SIDE_PX = 512, 704
"""Side of synthetic views, and longer side of photographs of places. Chosen by hand."""

SHIFT_PX = (15.0, 160.0)
"""The middles of two synthetic views differ by a random shift. Its standard deviation is drawn from
this range, so that some pairs overlap in a small part only."""

NEAR_PX, FAR_PX = 3.0, 6.0
"""Keypoints of both images correspond if their places differ by less than NEAR_PX. A keypoint has
no partner if the other image shows its place, but no keypoint within FAR_PX."""

MIN_MATCHES = 15
"""Pairs with fewer corresponding keypoints are drawn again. Chosen by hand."""

NONE, UNKNOWN = -1, -2
"""Values in `Pair.partners0` and `partners1`: no partner, and perhaps a partner."""

FIXED, MOVING = "fixed", "moving"
"""Folders in the folder of places. Each has a folder per place, with photographs of a fixed camera,
or from several viewpoints."""

UNSEEN = {
    FIXED: "fixed cameras need several photographs of one size with detail in both",
    MOVING: "places need photographs that `match_images` matches with high confidence",
}

UNCHANGED_SHARE = 0.35
"""Share of the photographs of fixed cameras that keep their viewpoint. Chosen by hand."""

ZOOM, TILT, TURN, OFFSET, PERSPECTIVE = (0.6, 1.25), 0.25, 0.12, 0.2, 4e-4
"""Other photographs of fixed cameras are seen from another viewpoint: the range of the scale, the
standard deviations of the logarithm of the tilt and of the angle in radians, the largest shift as a
fraction of the sides, and the standard deviation of the perspective per pixel. Chosen by hand."""

AROUND, AROUND_PX, MAX_DEVIATION_PX = 12, 8.0, 4.0
"""The place of a keypoint in the other photograph is predicted by an affinity of the AROUND nearest
dense matches. Half of them must lie within AROUND_PX, and all within MAX_DEVIATION_PX of the
affinity. Chosen by hand."""

LATER = 30
"""The second photograph of a place is at most LATER files after the first, because photographs far
apart in a sequence rarely show the same. Chosen by hand."""


class Pair(NamedTuple):
    """Keypoints of two images, and their partners.

    Attributes:
        inputs: the inputs of the network by name, from `attention_inputs`.
        partners0: (N,) row of the partner of each keypoint of the first image, NONE or UNKNOWN.
        partners1: (M,) the same for the second image.
    """

    inputs: dict[str, np.ndarray]
    partners0: np.ndarray
    partners1: np.ndarray


def draw_pairs(
    files: Sequence[Path],
    places: Path | None,
    folder: Path,
    seed: int,
    count: int,
    quiet: bool = True,
) -> list[Path]:
    """Draw pairs in parallel, one file each in `folder`; return the files.

    Files that exist are kept, so an interrupted drawing continues. With `places`, half of the pairs
    are synthetic, a quarter from fixed cameras, and a quarter from several viewpoints.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{seed}-{number:06d}.npz" for number in range(count)]
    missing = [number for number, path in enumerate(paths) if load_arrays(path) is None]
    with progress(len(missing), "drawing pairs", "pair", quiet) as bar:
        draw = partial(_write_pair, files, places, folder, seed)
        for _ in map_in_processes(draw, missing):
            bar.update()
    return paths


def _write_pair(
    files: Sequence[Path], places: Path | None, folder: Path, seed: int, number: int
) -> None:
    rng = np.random.default_rng([seed, number])
    if places is None or number % 2 == 0:
        unrelated = number % (2 * UNRELATED) == 0
        pair = draw_until_seen(partial(draw_synthetic, rng, files, unrelated))
    elif number % 4 == 1:
        pair = draw_until_seen(partial(draw_fixed, rng, _places(places, FIXED)), UNSEEN[FIXED])
    else:
        pair = draw_until_seen(partial(draw_moving, rng, _places(places, MOVING)), UNSEEN[MOVING])
    arrays = {**pair.inputs, "partners0": pair.partners0, "partners1": pair.partners1}
    save_arrays(folder / f"{seed}-{number:06d}.npz", arrays)


def read_pair(path: Path) -> Pair:
    """Read a file that `draw_pairs` wrote."""
    arrays = load_arrays(path)
    assert arrays is not None
    return Pair(arrays, arrays.pop("partners0"), arrays.pop("partners1"))


def files_of_places(folder: Path) -> list[Path]:
    """Return the photographs of all places; raise an OptionError if a kind of place is missing."""
    places = [*_places(folder, FIXED), *_places(folder, MOVING)]
    return [file for place in places for file in find_images(place)]


def _places(folder: Path, kind: str) -> list[Path]:
    """Return the folders of places of a kind."""
    found = sorted(each for each in (folder / kind).glob("*") if each.is_dir())
    if not found:
        raise OptionError(
            f"{folder} has no folders of photographs in '{kind}': put those of each place in one"
        )
    return found


def draw_synthetic(
    rng: np.random.Generator, files: Sequence[Path], unrelated: bool = False
) -> Pair | None:
    """Draw two synthetic views of a photograph, or of two; None if too little is seen in both."""
    shift_px = math.exp(rng.uniform(*np.log(SHIFT_PX)))
    layers, scales, _ = draw_layers(rng, files, SIDE_PX, shift_px)
    rendered = [render_layers(layers, side, scales[side]) for side in (0, 1)]
    views, tops = [view for view, _ in rendered], [top for _, top in rendered]
    if unrelated:
        others, other_scales, _ = draw_layers(rng, files, SIDE_PX)
        views[1] = render_layers(others, 1, other_scales[1])[0]
    first, second = (_extracted(photograph_view(rng, view / WHITE)) for view in views)
    if min(len(first), len(second)) < MIN_KEYPOINTS:
        return None
    if unrelated:
        return _pair(first, second, *(np.full(len(each), NONE) for each in (first, second)))
    there, _, seen = correspond(layers, tops, first.xy)
    back, _, seen_back = correspond(
        [layer._replace(views=layer.views[::-1]) for layer in layers], tops[::-1], second.xy
    )
    hidden = []
    for side, (features, seen_there) in enumerate(((first, seen), (second, seen_back))):
        # Views show photographs mirrored beyond their borders, so matches there may be right.
        column, row = np.rint(features.xy).astype(int).clip(0, SIDE_PX - 1).T
        mirrored = np.zeros(len(features), bool)
        for number, layer in enumerate(layers):
            place = layer.views[side].to_photograph(features.xy)
            last = np.array(layer.photograph.shape[1::-1]) - 1
            outside = ~((place >= 0) & (place <= last)).all(1)
            mirrored |= outside & (tops[side][row, column] == number)
        hidden.append(~seen_there & ~mirrored)
    return labelled(first, second, (there, back), (seen, seen_back), (hidden[0], hidden[1]))


def draw_fixed(rng: np.random.Generator, places: Sequence[Path]) -> Pair | None:
    """Draw two photographs of a fixed camera, each from a random viewpoint; None if unlike."""
    drawn = _two_photographs(rng, places)
    if drawn is None or drawn[0].shape != drawn[1].shape:
        return None
    height, width = drawn[0].shape[:2]
    seen, matrices = [], []
    for photograph in drawn:
        view, matrix = photograph, np.eye(3)
        if not happens(rng, UNCHANGED_SHARE):
            linear = rotation(rng.normal(0, TURN)) * math.exp(rng.uniform(*np.log(ZOOM)))
            root = math.exp(abs(rng.normal(0, TILT))) ** 0.5
            linear = linear @ scaled_along(rng.uniform(0, math.pi), root, 1 / root)
            middle = np.array([width, height]) * (0.5 + rng.uniform(-OFFSET, OFFSET, 2))
            side = min(height, width)
            matrix = view_homography(side, middle, linear, rng.normal(0, PERSPECTIVE, 2))
            how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            view = cv2.warpPerspective(photograph, matrix, (side, side), flags=how)
        features = _extracted(view)
        place = transform_points(features.xy, matrix)
        inside = np.asarray(((place > 0) & (place < [width - 1, height - 1])).all(1))
        seen.append(features[inside])
        matrices.append(matrix)
    first, second = seen
    if min(len(first), len(second)) < MIN_KEYPOINTS:
        return None
    across = np.linalg.inv(matrices[1]) @ matrices[0]
    ends = transform_points(first.xy, across), transform_points(second.xy, np.linalg.inv(across))
    shown = [
        np.asarray(((end > 0) & (end < np.array(other.image_size) - 1)).all(1))
        for end, other in zip(ends, (second, first), strict=True)
    ]
    return labelled(first, second, ends, (shown[0], shown[1]), (~shown[0], ~shown[1]))


def draw_moving(rng: np.random.Generator, places: Sequence[Path]) -> Pair | None:
    """Draw two photographs of a place that `match_images` matches with high confidence, or None."""
    drawn = _two_photographs(rng, places)
    if drawn is None:
        return None
    try:
        matches = match_images(*drawn)
    except DeepDetectError:  # a panorama or a fisheye picture
        return None
    if matches.geometry is None or matches.geometry.confidence != "high":
        return None
    first, second = map(_extracted, drawn)
    if min(len(first), len(second)) < MIN_KEYPOINTS:
        return None
    dense = matches.points0.astype(np.float64), matches.points1.astype(np.float64)
    ends = predicted(first.xy, *dense), predicted(second.xy, *dense[::-1])
    known = [np.isfinite(end[:, 0]) for end in ends]
    nowhere = [np.zeros(len(each), bool) for each in known]
    return labelled(first, second, ends, (known[0], known[1]), (nowhere[0], nowhere[1]))


def labelled(
    first: Keypoints,
    second: Keypoints,
    ends: tuple[np.ndarray, np.ndarray],
    known: tuple[np.ndarray, np.ndarray],
    hidden: tuple[np.ndarray, np.ndarray],
) -> Pair | None:
    """Return a pair, or None if too few keypoints correspond.

    For each image, `ends` are the places of its keypoints in the other image, `known` tells where
    these are right, and `hidden` which keypoints cannot be seen in the other image. A hidden one
    near a keypoint of the other image may have it as a partner all the same.
    """
    partners = [np.full(len(each), UNKNOWN) for each in (first, second)]
    for side, other in enumerate((second, first)):
        told = known[side] | (hidden[side] & np.isfinite(ends[side]).all(1))
        away = KDTree(other.xy).query(np.where(told[:, None], ends[side], -1e6))[0]
        partners[side][(known[side] | hidden[side]) & (away >= FAR_PX)] = NONE
    rows0 = np.flatnonzero(known[0])
    away, rows1 = KDTree(second.xy).query(ends[0][rows0])
    mutual = KDTree(ends[0][rows0]).query(second.xy[rows1])[1] == np.arange(len(rows0))
    matched = mutual & (away < NEAR_PX)
    if np.count_nonzero(matched) < MIN_MATCHES:
        return None
    partners[0][rows0[matched]] = rows1[matched]
    partners[1][rows1[matched]] = rows0[matched]
    return _pair(first, second, *partners)


def predicted(xy: np.ndarray, points0: np.ndarray, points1: np.ndarray) -> np.ndarray:
    """Return where dense matches predict (N, 2) positions in the other image; NaN if unknown."""
    ends = np.full((len(xy), 2), np.nan)
    if len(points0) < AROUND:
        return ends
    away, near = KDTree(points0).query(xy, AROUND)
    for row in np.flatnonzero(away[:, AROUND // 2 - 1] < AROUND_PX):
        here = np.column_stack([points0[near[row]] - xy[row], np.ones(AROUND)])
        affinity, _, rank, _ = np.linalg.lstsq(here, points1[near[row]], rcond=None)
        deviations = np.abs(here @ affinity - points1[near[row]]).max()
        if rank == 3 and deviations < MAX_DEVIATION_PX:
            ends[row] = affinity[2]
    return ends


def _two_photographs(
    rng: np.random.Generator, places: Sequence[Path]
) -> tuple[np.ndarray, np.ndarray] | None:
    files = find_images(places[int(rng.integers(len(places)))])
    if len(files) < 2:
        return None
    start = int(rng.integers(len(files)))
    later = int(rng.integers(1, min(len(files), LATER + 1)))
    chosen = files[start], files[(start + later) % len(files)]
    first, second = (downscale(load_image(file), MAX_SIDE_PX)[0] for file in chosen)
    return first, second


def _extracted(image: np.ndarray) -> Keypoints:
    return PointDetector(KEYPOINTS).extract(image)


def _pair(
    first: Keypoints, second: Keypoints, partners0: np.ndarray, partners1: np.ndarray
) -> Pair:
    inputs = attention_inputs(first, second)
    inputs |= {f"descriptors{k}": inputs[f"descriptors{k}"].astype(np.float16) for k in (0, 1)}
    return Pair(inputs, partners0.astype(np.int16), partners1.astype(np.int16))
