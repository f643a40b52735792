"""Match two images: keypoints, descriptors, geometry (Section III-C of the DeepDetect paper)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.machine import limited_threads, require_memory
from .._shared.options import suggest_keywords
from .._shared.progress import StageTimer
from ..detector.backends import RuntimeOptions
from ..detector.detector import AnyDetector, DeepDetect, check_selection, find_keypoints
from ..features.keypoints import Keypoints, nearest_keypoints
from ..features.learned import is_learned, match_learned, ratio_limit
from ..features.match_filter import check_filter, filter_matches, require_suited
from ..features.matchers import (
    DescriptorMatches,
    get_matcher,
    match_descriptors,
)
from ..features.matches import Matches, TwoViewGeometry
from ..features.selection import SelectionOptions
from ..geometry import Geometry, GeometryOptions, estimate_geometry
from ..geometry.estimation import check_model, check_seed
from ..geometry.transforms import epipolar_errors, transfer_errors
from ..io.image import Images, at_pixels, load_pair
from ..io.projection import require_pinhole
from .by_graph import match_by_graph
from .guided import Explanation, ImagePair
from .overlay import scene_of, still_matches, tell_still

GUIDED_STAGES = ("keypoints", "guided matching", "geometry")
"""Names of the stages that `match_images` reports to `progress`, in this order."""

MAX_RETURN_ERROR_PX = 2.0
"""If `mutual`, the second image is also matched to the first. A match is kept only if the reverse
match that starts nearest to its end leads back this near to its start. Chosen by hand."""

Points = tuple[np.ndarray, np.ndarray]


@suggest_keywords
@limited_threads()
def match_images(
    image0: Any,
    image1: Any,
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Images | None = None,
    model: str = "auto",
    mutual: bool = False,
    tentative_matches: Points | None = None,
    seed: int = 0,
    options: GeometryOptions = GeometryOptions(),
    progress: Callable[[str], object] | None = None,
) -> Matches:
    """Detect and match the keypoints of two images: a geometry from a few matches guides the rest.

    Args:
        image0, image1: anything `load_image` takes.
        detector: a `DeepDetect` or a `PointDetector`, or any object with a method `heatmap` or
            `detect` like theirs; default `DeepDetect()`.
        channels: order of the colours in arrays: "rgb", or "bgr" as in OpenCV.
        selection: which pixels of a heat map become keypoints; None: those above 0.5. Not for a
            `PointDetector`.
        ignore: a tuple with a mask or None for each image, or one mask for both images. A mask is
            true where no keypoint is wanted.
        model: the geometry, which also guides the matching: "homography" (planes, pure rotation),
            "fundamental" (any static scene), "essential" (needs both cameras), or "auto": whichever
            of "homography" and "fundamental" fits the images.
        mutual: keep only one-to-one matches that are found in both directions, which takes twice
            the time. The order of the images then does not matter.
        tentative_matches: matches of another matcher (LightGlue, LoFTR, clicks), some of which may
            be wrong: two (K, 2) arrays of corresponding positions. They are tried first.
        seed: seed of all random choices.
        options: how the final geometry is estimated.
        progress: called with the name of each stage when it ends.

    Returns:
        The matches, their geometry, and which matches agree with it. If no geometry can be trusted,
        there are no matches, and `Matches.success` is False.

    Raises:
        ImageError: an image cannot be read; or, except for the model "homography", is a panorama or
            a fisheye picture, or both images are from a lens that bends straight lines.
        OptionError: an option is unknown or out of its range.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64), np.uint8).repeat(2, 0).repeat(2, 1)
        >>> matches = match_images(image, image, model="homography")
        >>> bool((matches.points0 == matches.points1).all())
        True
    """
    check_model(model, seed, options)
    guiding = "fundamental" if model == "essential" else model
    given = None if tentative_matches is None else _checked_positions(tentative_matches)
    detector = DeepDetect() if detector is None else detector
    check_selection(detector, selection)
    masks: Sequence[np.ndarray | None]
    rgb, masks = load_pair((image0, image1), channels, ignore)
    if model != "homography":
        _require_pinholes((image0, image1), rgb, rim=False)
    pair, left_out = scene_of(rgb, masks, seed)
    timer = StageTimer(progress)
    with timer.stage("keypoints"):
        keypoints0, keypoints1 = (
            find_keypoints(detector, image, selection, mask)
            for image, mask in zip(rgb, pair.masks, strict=True)
        )
    settings = guiding, model, seed, options, timer
    matches = _match_guided(pair, (keypoints0, keypoints1), given, *settings)
    matches = _unmasked(matches, pair, left_out)
    if matches.geometry is not None and matches.geometry.model not in ("homography", "none"):
        _require_pinholes((image0, image1), rgb, rim=True)  # homographies also fit round pictures
    if not (mutual and matches.success):
        return matches
    given = None if given is None else given[::-1]
    back = _match_guided(pair.swapped(), (keypoints1, keypoints0), given, *settings)
    back = _unmasked(back, pair.swapped(), left_out)
    return _found_both_ways(matches, back)


@suggest_keywords
@limited_threads()
def match_features(
    features0: Keypoints,
    features1: Keypoints,
    *,
    matcher: str = "auto",
    filter_by: Literal["ratio", "neighbours"] = "ratio",
    ratio: float | None = None,
    mutual: bool = True,
    seed: int = 0,
    backend: str = "auto",
    device: str = "cpu",
) -> Matches:
    """Match two images by the descriptors of their keypoints alone, as `extract` returns them.

    Args:
        features0, features1: keypoints with descriptors of one type.
        matcher: "flann", "exact", "patchmatch", "hamming" for binary descriptors, or "auto":
            "exact" for few keypoints, otherwise "patchmatch" for dense ones and "flann" for others.
        filter_by: which nearest neighbours are matches: "ratio" keeps those that pass Lowe's ratio
            test; with "neighbours", a small network keeps those that move, rotate and scale as the
            matches around them. This gives more correct and fewer wrong matches than "ratio", but
            needs at least nine mutual neighbours, learned descriptors (not cross-modal) or
            RootSIFT, and keypoints with sizes and angles.
        ratio: maximum ratio of the descriptor distances to the nearest and the second-nearest
            neighbour. None: 0.91 for "learned", 0.9 for "cross-modal", 0.88 if otherwise learned,
            0.85 for all others. These limits are equally strict.
        mutual: keep only mutual nearest neighbours.
        seed: seed of a randomised matcher.
        backend, device: what compares learned descriptors, as in `PointDetector`. Other values than
            these need the matcher "auto" or "exact", and memory on the device for all distances.

    Returns:
        The matches, without a geometry (see `estimate_geometry`). Their scores are 1 - ratio or,
        with "neighbours", the network's probabilities, above 0.5, that the match is correct.

    Raises:
        OptionError: an option is unknown, out of its range, or incompatible with the others; or
            descriptors are missing, of two types or lengths, or too many for the memory.

    Example:
        >>> from deepdetect import PointDetector
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64), np.uint8).repeat(2, 0).repeat(2, 1)
        >>> features = PointDetector(100).extract(image)
        >>> matches = match_features(features, features)
        >>> bool((matches.points0 == matches.points1).all())
        True
    """
    if features0.descriptors is None or features1.descriptors is None:
        raise OptionError("these keypoints have no descriptors: use the detector's `extract`")
    length0, length1 = features0.descriptors.shape[1], features1.descriptors.shape[1]
    if (features0.descriptor_type, length0) != (features1.descriptor_type, length1):
        raise OptionError(
            f"descriptors of the types {features0.descriptor_type} ({length0} numbers) and "
            f"{features1.descriptor_type} ({length1}) cannot be compared: extract the same type"
        )
    check_seed(seed)
    learned = is_learned(features0.descriptor_type)
    check_filter(filter_by, ratio, mutual)
    by_neighbours = filter_by == "neighbours"
    if by_neighbours:
        require_suited(features0, features1)
    if ratio is None:
        ratio = ratio_limit(features0.descriptor_type)
    if not 0 < ratio <= 1:
        raise OptionError(f"the ratio must be above 0 and at most 1, not {ratio}")
    check_memory([len(features0), len(features1)])
    alike = features0.sizes is None and features1.sizes is None  # keypoints share scale and angle
    limits: dict[str, Any] = {"ratio": math.inf if by_neighbours else ratio, "mutual": mutual}
    nearest: Callable[[np.ndarray, np.ndarray], DescriptorMatches] = partial(
        match_descriptors,
        matcher=get_matcher(matcher),
        seed=seed,
        positions=(features0.xy, features1.xy) if alike else None,
        **limits,
    )
    if (backend, device) != ("auto", "cpu"):
        if not learned or matcher not in ("auto", "exact"):
            raise OptionError(
                "`backend` and `device` need learned descriptors and exact search: leave them out"
            )
        nearest = partial(match_by_graph, runtime=RuntimeOptions(backend, device), **limits)

    def match(first: np.ndarray, second: np.ndarray) -> DescriptorMatches:
        found = nearest(first, second)
        return filter_matches(features0, features1, found) if by_neighbours else found

    if learned:
        matches, _ = match_learned(features0, features1, match)
    else:
        matches = match(features0.descriptors, features1.descriptors)
    return Matches(
        features0.xy[matches.indices0],
        features1.xy[matches.indices1],
        np.clip(1 - matches.ratios, 0, 1),
        np.ones(len(matches), bool),
        features0,
        features1,
        indices0=matches.indices0,
        indices1=matches.indices1,
    )


def _noted(matches: Matches, left_out: float) -> Matches:
    """Note the image share left out as still; if above 1/2, "high" confidence becomes "fair"."""
    if (geometry := matches.geometry) is None:
        return matches
    evidence = replace(geometry.evidence, left_out=left_out + geometry.evidence.left_out)
    unsure = geometry.confidence == "high" and evidence.left_out > 1 / 2
    confidence = "fair" if unsure else geometry.confidence
    return replace(matches, geometry=replace(geometry, evidence=evidence, confidence=confidence))


def _match_guided(
    pair: ImagePair,
    keypoints: tuple[Keypoints, Keypoints],
    given: Points | None,
    guiding: str,
    model: str,
    seed: int,
    options: GeometryOptions,
    timer: StageTimer,
) -> Matches:
    """Match the keypoints of the first image where a geometry predicts their partners."""
    with timer.stage("guided matching"):
        explanation = Explanation(pair, keypoints, guiding, given, seed)
        guide, matched = explanation.answer()
        tell_still(guide.evidence.left_out)
    if matched is None:
        return _no_matches(*keypoints, guide, timer)
    points = matched.starts(explanation.pixels[0]), matched.points1
    # If both ends are keypoints, their sub-pixel positions replace the rounded ones.
    if matched.indices1 is not None:
        points = keypoints[0].xy[matched.indices0], keypoints[1].xy[matched.indices1]
    with timer.stage("geometry"):
        geometry = _final_geometry(points, model, seed, options, guide)
        assert matched.alike is not None
        inliers = geometry.inliers & matched.alike
    if geometry.matrix is None:
        return _no_matches(*keypoints, TwoViewGeometry("none", evidence=guide.evidence), timer)
    return Matches(
        *points,
        matched.scores,
        inliers,
        *keypoints,
        timer.seconds,
        replace(guide, model=geometry.model, matrix=geometry.matrix),
        matched.subpixel,
        matched.indices0,
        matched.indices1,  # type: ignore[arg-type]  # None: looked up later
        matched.layer,  # type: ignore[arg-type]
    )


def _checked_positions(points: Any) -> Points:
    """Check sparse matches of another matcher; return two (K, 2) float64 arrays of positions."""
    try:
        points0, points1 = (np.array(each, np.float64) for each in points)
    except (TypeError, ValueError):
        points0 = points1 = np.empty(0)
    if points0.ndim != 2 or points0.shape[1:] != (2,) or points0.shape != points1.shape:
        raise OptionError(
            "tentative matches must be two arrays of shape (K, 2): positions in both images"
        )
    if not (np.isfinite(points0).all() and np.isfinite(points1).all()):
        raise OptionError("tentative matches must be finite positions: leave out all other matches")
    return points0, points1


def _require_pinholes(images: tuple[Any, Any], rgb: Points, *, rim: bool) -> None:
    """Raise an ImageError if one of two images is a panorama, a fisheye or, with `rim`, round."""
    for number, image in enumerate(images):
        require_pinhole(image, rgb[number], rim=rim, name=f"images[{number}]")


def _unmasked(matches: Matches, pair: ImagePair, left_out: float) -> Matches:
    """Drop matches with an end in an ignore mask, and those on an overlay that stands still."""
    ends, masks = (matches.points0, matches.points1), pair.masks
    dropped = at_pixels(masks[0], ends[0]) | at_pixels(masks[1], ends[1])
    if matches.geometry is not None and matches.geometry.model not in ("homography", "none"):
        still, share = still_matches(pair, *ends)
        if still.any():
            tell_still(share)
            dropped, left_out = dropped | still, left_out + share
    return _noted(matches[~dropped] if dropped.any() else matches, left_out)


def _found_both_ways(matches: Matches, back: Matches) -> Matches:
    """Keep one-to-one matches that are also found from the second image to the first."""
    if not back.success:
        return back.swapped()
    kept = []
    for one, other in ((matches, back), (back, matches)):
        size = one.keypoints1.image_size
        rows, distances = nearest_keypoints(one.points1, other.points0, size)
        returned = other.points1[rows] - one.points0
        near = np.isfinite(distances) & (np.linalg.norm(returned, axis=1) <= MAX_RETURN_ERROR_PX)
        kept.append(one[near].unique())
    alarms, back_alarms = (
        each.geometry.evidence.log10_nfa for each in (matches, back) if each.geometry is not None
    )
    return kept[0] if alarms <= back_alarms else kept[1].swapped()


def check_memory(keypoints: Sequence[int]) -> None:
    """Raise an OptionError if descriptors and their search trees would not fit in memory."""
    require_memory(
        f"matches of {' and '.join(f'{count:,}' for count in keypoints)} keypoints",
        "reduce them by max_keypoints, density, or a smaller resolution",
        matched_keypoint=sum(keypoints),
    )


def _no_matches(
    keypoints0: Keypoints, keypoints1: Keypoints, guide: TwoViewGeometry, timer: StageTimer
) -> Matches:
    nothing = np.empty((0, 2)), np.empty((0, 2)), np.empty(0), np.empty(0)
    return Matches(*nothing, keypoints0, keypoints1, timer.seconds, guide)


def _final_geometry(
    points: Points, model: str, seed: int, options: GeometryOptions, guide: TwoViewGeometry
) -> Geometry:
    """Return the guiding geometry if the model and options allow it, otherwise estimate one."""
    if options.homography is None and guide.matrix is not None and model in ("auto", guide.model):
        errors_of = transfer_errors if guide.model == "homography" else epipolar_errors
        errors = errors_of(*points, guide.matrix)
        return Geometry(guide.model, guide.matrix, errors < options.inlier_threshold)
    return estimate_geometry(*points, model, seed=seed, options=options)
