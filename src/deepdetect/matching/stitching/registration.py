"""Estimate homographies from many images to the frame of one of them.

Sparse keypoints show which images overlap. These pairs are registered by guided matching, and dense
keypoints must confirm them. The pairs with most matches form a spanning tree. Homographies composed
along the tree initialise a joint fit to all pairs. Pairs that disagree with this fit, or overlap in
it but were not registered, are matched again starting from it, and the fit is repeated.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np

from ..._shared.errors import RegistrationError
from ...detector.detector import AnyDetector, find_keypoints
from ...detector.point_detector import PointDetector
from ...features.keypoints import Keypoints, bayer_order
from ...features.selection import SelectionOptions
from ...features.sift import describe_keypoints
from ...geometry.images import downscale
from ...geometry.transforms import scaled_points, transfer_errors, transform_points
from ...geometry.two_view import GUIDING_THRESHOLDS_PX
from ...io.image import luma
from ..guided import ImagePair, Tentative
from ..guided.along_plane import PlaneTracks, match_along_plane
from ..guided.explanation import MIN_MATCHED_FRACTION, stands_still, straight_lines
from ..guided.judge import Judge
from ..guided.proposals import (
    LEARNED_KEYPOINTS,
    LEARNED_SIDE_PX,
    Hypothesis,
    learned_points,
    matched_points,
    planes,
)
from .bundle_adjustment import RegisteredPair, RotatingCamera, adjust_cameras, adjust_homographies

MAX_KEYPOINTS = 30_000
"""Maximum number of dense keypoints per image that confirm a homography. Chosen by hand."""

MIN_PARTNERS = 3
"""A pair is not registered, to save time, if other pairs already connect its images and each image
has at least this many registered partners."""

MIN_OVERLAP = 0.1
"""An unregistered pair is tried again if the joint fit maps at least this fraction of one image's
keypoints into the other image. Chosen by hand; not measured."""

MAX_DISAGREEMENT_PX = 2.0
"""A pair is tried again if its RMS distance from the joint fit exceeds this. Chosen by hand."""

MAX_CORRESPONDENCES = 400
"""Number of evenly spread matches per pair in the joint fit. Chosen by hand; not measured."""

MIN_STILL = 0.9
"""If two images, laid on each other unmoved, agree on less than this fraction of what both show,
only a menu or a caption stands still. Images of a still camera agree nearly everywhere."""

MIN_EXPLAINED = 0.3
"""Two images must agree, along a homography, on at least this fraction of what both show. Wrong
homographies of similar towers reached 0.12; screenshots of which half stands still had 0.59."""

MAX_RESIDUAL_PX = GUIDING_THRESHOLDS_PX["homography"]
"""Images contradict each other if the RMS residual of their joint fit exceeds the inlier threshold
of a homography: a typical match is then an outlier. Correct fits have residuals of 0.2 to 1 px."""


@dataclass(frozen=True, eq=False)
class JointRegistration:
    """Images in a common frame. The keys of the dictionaries are image numbers.

    `homographies` map to the frame of their first image, and are in the order in which images were
    connected. `cameras` is None unless rotating cameras are requested. `matches`, `residual_px` and
    `unregistered` are as in `Panorama`.
    """

    homographies: dict[int, np.ndarray]
    cameras: dict[int, RotatingCamera] | None
    matches: dict[tuple[int, int], int]
    residual_px: float
    unregistered: dict[int, str]


class _Image(NamedTuple):
    """A grey image, its sparse keypoints with descriptors, and its (N, 2) dense keypoints."""

    gray: np.ndarray
    features: Keypoints
    keypoints: np.ndarray


def register_images(
    images: Sequence[np.ndarray],
    detector: AnyDetector,
    *,
    reference: int | None = None,
    turning: bool = False,
    force: bool = False,
    seed: int = 0,
    progress: Callable[[str], object] | None = None,
    names: Sequence[str] = (),
) -> JointRegistration:
    """Find the homographies of overlapping uint8 images of 3 or 4 channels to a common frame.

    Sparse points find overlaps and dense keypoints confirm homographies; the points of a detector
    without heat map do both. The largest group of connected images is registered, or the group that
    contains image number `reference`. If `turning`, cameras that only rotate are estimated as well.
    If `force`, images that contradict each other give a warning, not an error. `names` are names
    of the images for messages.
    """
    done = progress or (lambda _: None)
    names = names or [f"images[{number}]" for number in range(len(images))]
    views = []
    for image in images:
        views.append(_prepare(image, detector))
        done("keypoints")
    pairs = _registered_pairs(views, seed, done)
    groups = sorted({tuple(sorted(_connected(k, pairs))) for k in range(len(images))})
    if reference is not None:
        group = next(group for group in groups if reference in group)
        nothing = f"the reference, {names[reference]}, overlaps with no other image"
    else:
        matches = {group: sum(p.matches for p in pairs if p.first in group) for group in groups}
        group = max(groups, key=lambda group: (len(group), matches[group]))
        nothing = f"no two of these {len(images)} images overlap"
    if len(group) == 1:
        raise RegistrationError(
            f"{nothing} with a reliable homography: take images with common detail, from one place "
            "or of a plane"
        )
    apart = "it overlaps only with others that are not in the panorama"
    reasons = "it overlaps with no other image", apart
    unregistered = {n: reasons[len(each) > 1] for each in groups if each != group for n in each}
    pairs = [pair for pair in pairs if pair.first in group]
    sizes = {number: views[number].gray.shape[::-1] for number in group}
    hint = "choose the projection 'plane'" if turning else "crop what stands still in all images"
    try:
        homographies, cameras, to_common, residual_px = _adjust(group, pairs, sizes, turning)
        again = _registered_again(views, to_common, pairs)
        if set(again) != set(pairs):
            pairs = again
            homographies, cameras, to_common, residual_px = _adjust(group, pairs, sizes, turning)
    except np.linalg.LinAlgError:
        raise RegistrationError(f"the images contradict each other: {hint}") from None
    worst = max(pairs, key=lambda pair: _disagreement_px(pair, to_common))
    off_px = _disagreement_px(worst, to_common)
    if residual_px > MAX_RESIDUAL_PX:
        reason = (
            f"{names[worst.first]} and {names[worst.second]} contradict each other where they "
            f"overlap ({off_px:.1f} px in the panorama): leave one of them out, or {hint}"
        )
        if not force:
            raise RegistrationError(f"{reason} (or set `force`)")
        warnings.warn(reason, UserWarning, stacklevel=3)
    counts = {(pair.first, pair.second): pair.matches for pair in pairs}
    return JointRegistration(homographies, cameras, counts, residual_px, unregistered)


def _adjust(
    group: Sequence[int],
    pairs: Sequence[RegisteredPair],
    sizes: dict[int, tuple[int, int]],
    turning: bool,
) -> tuple[dict[int, np.ndarray], dict[int, RotatingCamera] | None, dict[int, np.ndarray], float]:
    """Fit images jointly; return homographies, cameras, maps to the common frame, RMS residual."""
    homographies, residual_px = adjust_homographies(_compose(group, pairs), pairs, sizes)
    if not turning:
        return homographies, None, homographies, residual_px
    cameras, residual_px = adjust_cameras(homographies, pairs, sizes)
    to_common = {number: one.to_common(sizes[number]) for number, one in cameras.items()}
    return homographies, cameras, to_common, residual_px


def _disagreement_px(pair: RegisteredPair, to_common: dict[int, np.ndarray]) -> float:
    """Return the RMS distance of a pair's own homography from a joint fit, at its matches."""
    matrix = np.linalg.inv(to_common[pair.second]) @ to_common[pair.first]
    expected = transform_points(pair.points, pair.homography)
    return float(np.sqrt(np.mean(transfer_errors(pair.points, expected, matrix) ** 2)))


def _prepare(image: np.ndarray, detector: AnyDetector) -> _Image:
    gray = luma(image)
    if not hasattr(detector, "heatmap"):
        if isinstance(detector, PointDetector):
            points = detector.extract(image)
        else:
            points = describe_keypoints(gray, find_keypoints(detector, image))
        return _Image(gray, points, np.rint(points.xy))
    # Neighbouring pixels are verified together, so non-maximum suppression is off.
    keypoints = find_keypoints(detector, image, SelectionOptions(max_keypoints=MAX_KEYPOINTS))
    small, scale = downscale(gray, LEARNED_SIDE_PX)
    points = learned_points(small, LEARNED_KEYPOINTS)
    points = replace(points, xy=scaled_points(points.xy, 1 / scale), image_size=gray.shape[::-1])
    return _Image(gray, points, keypoints.xy)


def _registered_pairs(
    views: Sequence[_Image], seed: int, done: Callable[[str], object]
) -> list[RegisteredPair]:
    overlaps: list[tuple[list[Hypothesis], int, int]] = []
    for first, second in combinations(range(len(views)), 2):
        a, b = views[first], views[second]
        pair = ImagePair((a.gray, b.gray))
        points0, points1, _ = matched_points(a.features, b.features)
        pixel = max(1.0, max(b.gray.shape) / LEARNED_SIDE_PX)
        found = [*planes(pair, Tentative(points0, points1, pixel), seed)]
        if found:
            straight_lines(pair, found[0])
            overlaps.append((found, first, second))
        done("overlaps")
    overlaps.sort(key=lambda overlap: -np.count_nonzero(overlap[0][0].inliers))
    pairs: list[RegisteredPair] = []
    partners = np.zeros(len(views), int)
    for found, first, second in overlaps:
        enough = partners[[first, second]].min() >= MIN_PARTNERS
        if enough and second in _connected(first, pairs):
            continue
        # On repeated structure, most matches may be wrong, so all homographies are tried.
        tried = (_register(views, first, second, each.matrix) for each in found)
        registered = next((each for each in tried if each is not None), None)
        if registered is not None:
            pairs.append(registered)
            partners[[first, second]] += 1
    return pairs


def _register(
    views: Sequence[_Image], first: int, second: int, homography: np.ndarray
) -> RegisteredPair | None:
    """Register a pair by dense matches along a homography; None if the images reject it."""
    a, b = views[first], views[second]
    pair = ImagePair((a.gray, b.gray))
    judge = Judge(pair)
    matrix = PlaneTracks(pair, homography).homography
    view = judge.along_plane(matrix)
    still = stands_still(homography, pair.sizes)
    evidence, least = view.evidence, MIN_STILL if still else MIN_EXPLAINED
    if not evidence.confirms or evidence.share < least or view.repeated:
        return None
    pixels = np.rint(a.keypoints), np.rint(b.keypoints)
    matches = match_along_plane(pair, pixels, matrix, judge, evidence)
    points = a.keypoints[matches.indices0]
    if len(points) < MIN_MATCHED_FRACTION * min(len(xy) for xy in pixels):
        return None
    order = np.argsort(bayer_order(points, a.gray.shape[::-1]), kind="stable")
    spread = points[order[:MAX_CORRESPONDENCES]]
    return RegisteredPair(first, second, matrix, spread, len(points))


def _registered_again(
    views: Sequence[_Image],
    to_common: dict[int, np.ndarray],
    pairs: Sequence[RegisteredPair],
) -> list[RegisteredPair]:
    """Register pairs again, starting from the joint fit, if they disagree with it or are missing.

    On repeated or collinear structure (windows, towers), keypoints can give a wrong homography. The
    new result replaces the old one if it has more matches. A panorama of 360 degrees needs the pair
    that closes the loop, or its ends drift apart.
    """
    known = {(pair.first, pair.second): pair for pair in pairs}
    partners: dict[int, set[int]] = {number: set() for number in to_common}
    for one, other in known:
        partners[one].add(other)
        partners[other].add(one)
    result = []
    for first, second in combinations(sorted(to_common), 2):
        matrix = np.linalg.inv(to_common[second]) @ to_common[first]
        pair = known.get((first, second))
        if pair is None:
            near = bool(partners[first] & partners[second])
            enough = min(len(partners[first]), len(partners[second])) >= MIN_PARTNERS
            ways = (first, second, matrix), (second, first, np.linalg.inv(matrix))
            shown = max(_shown(views[a], views[b], between) for a, b, between in ways)
            good = (near and enough) or shown < MIN_OVERLAP
        else:
            good = _disagreement_px(pair, to_common) < MAX_DISAGREEMENT_PX
        if not good:
            again = _register(views, first, second, matrix)
            if again is not None:
                partners[first].add(second)
                partners[second].add(first)
                pair = again if pair is None or again.matches > pair.matches else pair
        if pair is not None:
            result.append(pair)
    return result


def _shown(first: _Image, second: _Image, homography: np.ndarray) -> float:
    """Return the fraction of the first image's keypoints that a homography maps into the second."""
    x, y, depth = homography @ np.vstack([first.keypoints.T, np.ones(len(first.keypoints))])
    height, width = second.gray.shape
    inside = (x > 0) & (x < depth * (width - 1)) & (y > 0) & (y < depth * (height - 1))
    return float(inside.mean())


def _connected(number: int, pairs: Sequence[RegisteredPair]) -> set[int]:
    """Return the images that pairs connect with a given image, itself included."""
    reached, before = {number}, 0
    while len(reached) > before:
        before, ends = len(reached), [{pair.first, pair.second} for pair in pairs]
        reached = reached.union(*(each for each in ends if each & reached))
    return reached


def _compose(group: Sequence[int], pairs: Sequence[RegisteredPair]) -> dict[int, np.ndarray]:
    """Compose homographies along the maximum spanning tree, to the frame of one image."""
    tree: list[RegisteredPair] = []
    for pair in sorted(pairs, key=lambda pair: -pair.matches):
        if pair.second not in _connected(pair.first, tree):
            tree.append(pair)
    matches = {n: sum(p.matches for p in pairs if n in (p.first, p.second)) for n in group}
    homographies = {max(group, key=lambda number: matches[number]): np.eye(3)}
    queue = list(homographies)
    for number in queue:
        for pair in tree:
            step, other = np.linalg.inv(pair.homography), pair.second
            if pair.second == number:
                step, other = pair.homography, pair.first
            if number in (pair.first, pair.second) and other not in homographies:
                homographies[other] = homographies[number] @ step
                queue.append(other)
    return homographies
