"""Homographies of many photographs into the frame of one.

Which photographs overlap is found with few keypoints. The pairs that do are registered by guided
matching, whose test by dense keypoints they must pass. The pairs with the most matches make a
spanning tree; homographies composed along it are the start of a fit to all pairs at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from ..._shared.errors import RegistrationError
from ...detector.detector import AnyDetector, find_keypoints
from ...features.keypoints import Keypoints, bayer_order
from ...features.selection import SelectionOptions
from ...features.sift import describe_keypoints
from ...features.sift_detector import detect_sift
from ...geometry.residuals import transform_points
from ...io.image import luma
from ..guided import TentativeMatches, guided_matches, tentative_matches
from ..guided.initial_geometry import estimate_initial_geometry
from .joint_fit import Correspondences, fit_jointly
from .options import DEFAULTS, StitchingOptions


@dataclass(frozen=True, eq=False)
class RegisteredPair:
    """Two images related by a homography that dense keypoints confirm.

    Attributes:
        first, second: numbers of the images.
        homography: (3, 3) from the first to the second.
        points: (M, 2) keypoints of the first that have a match in the second.
    """

    first: int
    second: int
    homography: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, eq=False)
class JointRegistration:
    """Images in a common frame.

    Attributes:
        homographies: (3, 3) each to the frame of the first one, by number of the image; in the
            order in which they were connected.
        matches: number of dense matches of each pair that was registered among these.
        residual_px: root mean square of the distances between where a pair's own homography
            takes its matches and where the joint fit does, in pixels; 0 without closed loops.
        left_out: why each other image is not among them.
    """

    homographies: dict[int, np.ndarray]
    matches: dict[tuple[int, int], int]
    residual_px: float
    left_out: dict[int, str]


@dataclass(frozen=True, eq=False)
class _Image:
    gray: np.ndarray
    features: Keypoints
    keypoints: np.ndarray

    @property
    def size(self) -> tuple[int, int]:
        return self.gray.shape[1], self.gray.shape[0]


def register_jointly(
    images: Sequence[np.ndarray],
    detector: AnyDetector,
    *,
    reference: int | None = None,
    options: StitchingOptions = DEFAULTS,
    seed: int = 0,
) -> JointRegistration:
    """Find the homographies of overlapping images to a common frame.

    Args:
        images: two or more, (H, W, 3) uint8 RGB each, their longer sides at most 1200 pixels.
        detector: of points, which find the overlaps and confirm the homographies; or of heat maps:
            SIFT's keypoints find the overlaps, dense ones confirm.
        reference: number of an image that must be among them; None for the most images.
        options: of panoramas.
        seed: of all random choices.

    Raises:
        RegistrationError: no two images overlap, or the reference with none.
    """
    views = [_prepare(image, detector, options) for image in images]
    pairs = _registered_pairs(views, options.min_partners, seed)
    groups = sorted({tuple(sorted(_connected(k, pairs))) for k in range(len(images))})
    if reference is not None:
        group = next(group for group in groups if reference in group)
    else:
        group = max(groups, key=lambda group: (len(group), _matches_within(group, pairs)))
    if len(group) == 1:
        what = f"no two of these {len(images)} images overlap"
        if reference is not None:
            what = f"the reference, images[{reference}], overlaps with no other image"
        raise RegistrationError(
            f"{what} so that a homography can be trusted: they must show common detail, and be "
            "taken from one place or show a plane"
        )
    left_out = {
        number: "it overlaps with no other image"
        if len(other) == 1
        else "it overlaps only with images that are left out"
        for other in groups
        if other != group
        for number in other
    }
    pairs = [pair for pair in pairs if pair.first in group]
    homographies, residual_px = fit_jointly(
        _compose(group, pairs),
        [_correspondences(pair, views, options.max_correspondences) for pair in pairs],
        {number: views[number].size for number in group},
        huber_threshold_px=options.huber_threshold_px,
    )
    matches = {(pair.first, pair.second): len(pair.points) for pair in pairs}
    return JointRegistration(homographies, matches, residual_px, left_out)


def _prepare(
    image: np.ndarray,
    detector: AnyDetector,
    options: StitchingOptions,
) -> _Image:
    gray = luma(image)
    if not hasattr(detector, "heatmap"):
        points = describe_keypoints(gray, find_keypoints(detector, image))
        return _Image(gray, points, np.rint(points.xy))
    # Without suppression: neighbouring pixels are what the verification compares.
    selection = SelectionOptions(max_keypoints=options.max_keypoints)
    keypoints = find_keypoints(detector, image, selection)
    return _Image(gray, detect_sift(gray, options.sift), keypoints.xy)


def _registered_pairs(
    views: Sequence[_Image], min_partners: int, seed: int
) -> list[RegisteredPair]:
    """Register the pairs that overlap most, until all are connected and have enough partners."""
    overlaps: list[tuple[int, int, int, TentativeMatches]] = []
    for first, second in combinations(range(len(views)), 2):
        a, b = views[first], views[second]
        initial = tentative_matches(a.gray, b.gray, (a.features, b.features))
        found = estimate_initial_geometry(initial, "homography", seed, simulate_views=False)
        if found.model != "none":
            overlaps.append((len(found.points0), first, second, initial))
    overlaps.sort(key=lambda overlap: -overlap[0])
    pairs: list[RegisteredPair] = []
    partners = [0] * len(views)
    for _, first, second, initial in overlaps:
        enough = min(partners[first], partners[second]) >= min_partners
        if enough and second in _connected(first, pairs):
            continue
        a, b = views[first], views[second]
        guide, matches = guided_matches(
            a.gray, b.gray, a.keypoints, b.keypoints, "homography", seed, initial
        )
        if guide.matrix is not None and matches is not None and len(matches):
            points = a.keypoints[matches.indices0]
            pairs.append(RegisteredPair(first, second, guide.matrix, points))
            partners[first] += 1
            partners[second] += 1
    return pairs


def _correspondences(pair: RegisteredPair, views: Sequence[_Image], count: int) -> Correspondences:
    """Choose matches of a pair, spread out."""
    order = np.argsort(bayer_order(pair.points, views[pair.first].size), kind="stable")
    points = pair.points[order[:count]]
    # The homography is sharper than keypoints on whole pixels.
    return Correspondences(
        pair.first, pair.second, points, transform_points(points, pair.homography)
    )


def _connected(number: int, pairs: Sequence[RegisteredPair]) -> set[int]:
    """Return the images that pairs connect with one of them, itself included."""
    reached = {number}
    while True:
        touching = [pair for pair in pairs if pair.first in reached or pair.second in reached]
        more = {end for pair in touching for end in (pair.first, pair.second)}
        if more <= reached:
            return reached
        reached |= more


def _matches_within(group: Sequence[int], pairs: Sequence[RegisteredPair]) -> int:
    return sum(len(pair.points) for pair in pairs if pair.first in group)


def _compose(group: Sequence[int], pairs: Sequence[RegisteredPair]) -> dict[int, np.ndarray]:
    """Compose homographies to the image with most matches, along the maximum spanning tree."""
    tree: list[RegisteredPair] = []
    matches = dict.fromkeys(group, 0)
    for pair in sorted(pairs, key=lambda pair: -len(pair.points)):
        if pair.second not in _connected(pair.first, tree):
            tree.append(pair)
        matches[pair.first] += len(pair.points)
        matches[pair.second] += len(pair.points)
    homographies = {max(group, key=lambda number: matches[number]): np.eye(3)}
    queue = list(homographies)
    for number in queue:
        for pair in tree:
            if pair.first == number and pair.second not in homographies:
                other, step = pair.second, np.linalg.inv(pair.homography)
            elif pair.second == number and pair.first not in homographies:
                other, step = pair.first, pair.homography
            else:
                continue
            homographies[other] = homographies[number] @ step
            queue.append(other)
    return homographies
