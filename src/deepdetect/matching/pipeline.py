"""Matching two images: keypoints, descriptors, ratio test, geometry (paper, Section III-C)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.options import suggest_keywords
from .._shared.timing import StageTimer
from ..detector.detector import AnyDetector, DeepDetect, check_selection, find_keypoints
from ..detector.image_lists import Images
from ..features.keypoints import Keypoints
from ..features.matches import Matches, TwoViewGeometry, lazy
from ..features.selection import SelectionOptions
from ..geometry import Geometry, GeometryOptions, estimate_geometry
from ..geometry.estimation import check_model
from ..geometry.transforms import epipolar_errors, transfer_errors
from ..io.image import load_image, luma
from .guided import GuidedMatches, TentativeMatches, guided_matches, guiding_geometry
from .options import MatchingOptions
from .unguided import unguided_matches

Points = tuple[np.ndarray, np.ndarray]
Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class LoadedPair:
    """Two images, each loaded and converted once.

    Attributes:
        rgb: (H, W, 3) uint8 both.
        gray: (H, W) uint8 luma both.
    """

    rgb: tuple[np.ndarray, np.ndarray]
    gray: tuple[np.ndarray, np.ndarray]

    @classmethod
    def load(cls, image0: Any, image1: Any, channels: Channels = "rgb") -> LoadedPair:
        """Load two images; arguments and errors as of `load_image`."""
        rgb = load_image(image0, channels=channels), load_image(image1, channels=channels)
        return cls(rgb, (luma(rgb[0]), luma(rgb[1])))


@suggest_keywords
def match_images(
    image0: Any,
    image1: Any,
    detector: AnyDetector | None = None,
    *,
    channels: Channels = "rgb",
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Images | None = None,
    guided_matching: bool = True,
    model: str = "auto",
    mutual: bool = False,
    tentative_matches: Points | TentativeMatches | None = None,
    seed: int = 0,
    options: MatchingOptions = MatchingOptions(),
    progress: Callable[[str], object] | None = None,
) -> Matches:
    """Detect and match the keypoints of two images.

    Args:
        image0, image1: anything `load_image` takes.
        detector: a `DeepDetect` or a `PointDetector`, or anything with a method `heatmap` or
            `detect`, as these have; default `DeepDetect()`.
        channels: order of the colours in images that are arrays, as of `load_image`: "bgr" for
            those of OpenCV.
        selection: which pixels of a heat map become keypoints; None: those over 0.5. A
            `PointDetector` has none.
        ignore: a mask for each image, or None, in a tuple; or one array for both: true where no
            keypoint is wanted.
        guided_matching: whether a geometry from a few matches guides the matching, or descriptors
            alone decide.
        model: the geometry, "homography" (planes, pure rotation), "fundamental" (any static
            scene), "essential" (with both cameras in `options.geometry`), "auto" (one of the first
            two) or "none"; it also chooses what guides.
        mutual: keep only mutual nearest neighbours; guided, the best match of each keypoint, and
            the same matches whichever image comes first.
        tentative_matches: a few matches of any other matcher (LightGlue, LoFTR, a person's clicks),
            two (K, 2) arrays of positions, row by row; they take the place of our own SIFT matches
            that guide, and some may be wrong. Or what `find_tentative_matches` has made already.
        seed: of all random choices.
        options: all else.
        progress: called with the name of each stage when it ends.

    Returns:
        The matches, the geometry, and which agree with it. Where guided matching can trust no
        geometry there are none (`Matches.success` is False), and the keypoints are found when they
        are first asked for; `guided_matching=False` matches by descriptors alone.

    Raises:
        ImageError: an image cannot be read or is not fit.
        OptionError: an option is unknown or out of its range.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64), np.uint8).repeat(2, 0).repeat(2, 1)
        >>> matches = match_images(image, image, model="homography")
        >>> bool((matches.points0 == matches.points1).all())
        True
    """
    return match_pair(
        LoadedPair.load(image0, image1, channels),
        detector,
        selection=selection,
        ignore=ignore,
        guided_matching=guided_matching,
        model=model,
        mutual=mutual,
        tentative_matches=tentative_matches,
        seed=seed,
        options=options,
        progress=progress,
    )


def match_pair(
    pair: LoadedPair,
    detector: AnyDetector | None = None,
    *,
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Images | None = None,
    guided_matching: bool = True,
    model: str = "auto",
    mutual: bool = False,
    tentative_matches: Points | TentativeMatches | None = None,
    seed: int = 0,
    options: MatchingOptions = MatchingOptions(),
    progress: Callable[[str], object] | None = None,
) -> Matches:
    """Match two loaded images; all else as of `match_images`."""
    check_model(model, seed, options.geometry)
    guiding = guiding_model(model, options)
    if tentative_matches is not None and not guided_matching:
        raise OptionError("`tentative_matches` guide: leave them out, or `guided_matching=False`")
    timer = StageTimer(progress)
    detector = DeepDetect() if detector is None else detector
    check_selection(detector, selection)
    masks = ignore if isinstance(ignore, (list, tuple)) else (ignore, ignore)
    if len(masks) != 2:
        raise OptionError(f"`ignore` holds {len(masks)} masks for two images: give one each")
    find = [
        partial(find_keypoints, detector, rgb, selection, mask)
        for rgb, mask in zip(pair.rgb, masks, strict=True)
    ]
    if not guided_matching:
        with timer.stage("keypoints"):
            keypoints0, keypoints1 = find[0](), find[1]()
        found = unguided_matches(pair.gray, (keypoints0, keypoints1), options, mutual, seed, timer)
        points0, points1 = keypoints0.xy[found.indices0], keypoints1.xy[found.indices1]
        with timer.stage("geometry"):
            geometry = estimate_geometry(
                points0, points1, model, seed=seed, options=options.geometry
            )
        return Matches(
            points0,
            points1,
            np.clip(1 - found.ratios, 0, 1),
            geometry.inliers,
            geometry.model,
            geometry.matrix,
            keypoints0,
            keypoints1,
            timer.seconds,
            indices0=found.indices0,
            indices1=found.indices1,
        )
    swapped = mutual and _comes_after(*pair.gray)
    gray0, gray1 = _ordered(pair.gray, swapped)
    known = tentative_matches
    if isinstance(known, TentativeMatches):
        known = known.swapped() if swapped else known
    elif known is not None:
        known = _ordered((known[0], known[1]), swapped)
    first = None
    # Keypoints of the network take no part in the first geometry, and finding them cannot fail:
    # where no geometry can be trusted nobody may ever ask for them.
    if isinstance(detector, DeepDetect) and all(mask is None for mask in masks):
        with timer.stage("initial geometry"):
            first = guiding_geometry(gray0, gray1, guiding, seed, known)
        if first.matrix is None:
            guide = first.as_two_view_geometry()
            return _no_matches((lazy(find[0]), lazy(find[1])), guide, timer)
    with timer.stage("keypoints"):
        keypoints = find[0](), find[1]()
    with timer.stage("guided matching"):
        ordered = _ordered(keypoints, swapped)
        guide, matched = guided_matches(
            gray0,
            gray1,
            np.rint(ordered[0].xy),
            np.rint(ordered[1].xy),
            guiding,
            seed,
            known,
            points=ordered,
            first=first,
        )
    if swapped:
        guide = guide.swapped()
    if matched is None:
        return _no_matches(keypoints, guide, timer)
    if mutual:
        matched = matched.unique()
    points0, points1 = _ordered(_points_of(matched, ordered), swapped)
    indices0, indices1 = _ordered((matched.indices0, matched.indices1), swapped)
    with timer.stage("geometry"):
        geometry = _final_geometry(points0, points1, model, seed, options.geometry, guide)
    return Matches(
        points0,
        points1,
        matched.scores,
        geometry.inliers,
        geometry.model,
        geometry.matrix,
        *keypoints,
        timer.seconds,
        guide,
        matched.subpixel,
        indices0,  # type: ignore[arg-type]  # looked up where there are none
        indices1,  # type: ignore[arg-type]
    )


def _ordered(both: tuple[Item, Item], swapped: bool) -> tuple[Item, Item]:
    return (both[1], both[0]) if swapped else both


def guiding_model(model: str, options: MatchingOptions) -> str:
    """Return the geometry that guides: a plane would drop what is off it, so the model decides.

    Raises:
        OptionError: the model and the options contradict each other.
    """
    open_to = options.two_view_model
    fitting = {"essential": "fundamental", "auto": open_to, "none": open_to}.get(model, model)
    if options.two_view_model not in ("auto", fitting):
        raise OptionError(
            f"`two_view_model={options.two_view_model!r}` contradicts the model {model}: leave "
            "one of them out"
        )
    return fitting


def _no_matches(
    keypoints: Sequence[Keypoints], guide: TwoViewGeometry, timer: StageTimer
) -> Matches:
    nothing, nowhere = np.empty(0, np.float32), np.empty((0, 2), np.float32)
    return Matches(
        *(nowhere, nowhere, nothing, nothing, "none", None),
        keypoints[0],
        keypoints[1],
        timer.seconds,
        guide,
    )


def _comes_after(gray0: np.ndarray, gray1: np.ndarray) -> bool:
    """Order images by their pixels, so that a pair and the swapped pair are matched alike."""
    keys = [(gray.shape, hashlib.sha256(gray.tobytes()).digest()) for gray in (gray0, gray1)]
    return keys[0] > keys[1]


def _points_of(
    found: GuidedMatches, keypoints: Sequence[Keypoints]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of matches in both images."""
    points0 = keypoints[0].xy[found.indices0]
    if found.indices1 is not None:
        return points0, keypoints[1].xy[found.indices1]
    # The end in the second image is where the pixel of the first one is seen.
    return np.rint(points0), found.points1.astype(np.float32)


def _final_geometry(
    points0: np.ndarray,
    points1: np.ndarray,
    model: str,
    seed: int,
    options: GeometryOptions,
    guide: TwoViewGeometry,
) -> Geometry:
    """Return the geometry that guided where that is asked for, else estimate one."""
    if options.homography is None and guide.matrix is not None and model in ("auto", guide.model):
        errors_of = transfer_errors if guide.model == "homography" else epipolar_errors
        errors = errors_of(points0, points1, guide.matrix)
        return Geometry(guide.model, guide.matrix, errors < options.inlier_threshold)
    return estimate_geometry(points0, points1, model, seed=seed, options=options)
