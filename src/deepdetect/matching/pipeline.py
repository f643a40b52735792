"""Matching two images: keypoints, descriptors, ratio test, geometry (paper, Section III-C)."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.options import replace_options, suggest_keywords
from .._shared.timing import StageTimer
from ..detector.detector import DeepDetect, HeatmapDetector, find_keypoints
from ..detector.heatmap import HeatmapOptions
from ..features.keypoints import Keypoints
from ..features.matches import Guide, Matches, found_later
from ..geometry import Geometry, GeometryOptions, estimate_geometry
from ..geometry.residuals import epipolar_errors, transfer_errors
from ..io.image import load_image, luma
from .guided import (
    GuidedMatches,
    GuidedOptions,
    InitialGeometry,
    InitialMatches,
    guided_matches,
    guiding_geometry,
)
from .options import MatchingOptions, get_preset
from .unguided import unguided_matches


@suggest_keywords
def match_images(
    image0: Any,
    image1: Any,
    detector: HeatmapDetector | None = None,
    *,
    channels: Channels = "rgb",
    preset: str = "default",
    options: MatchingOptions | None = None,
    initial: InitialMatches | None = None,
    seeds: tuple[np.ndarray, np.ndarray] | None = None,
    guided: bool | None = None,
    model: str | None = None,
    guide: str | None = None,
    mutual: bool | None = None,
    threshold: float | None = None,
    density: float | None = None,
    max_keypoints: int | None = None,
    nms_radius: int | None = None,
    subpixel: bool | None = None,
    ignore: np.ndarray | None = None,
    mode: Literal["auto", "dense", "points"] | None = None,
    spread: Literal["none", "grid", "anms"] | None = None,
    resolution: Literal["auto", "native"] | int | None = None,
    network_channels: Channels | None = None,
    descriptor: str | None = None,
    keypoint_size: float | None = None,
    angle: float | None = None,
    matcher: str | None = None,
    ratio: float | None = None,
    estimator: str | None = None,
    inlier_threshold: float | None = None,
    homography: np.ndarray | None = None,
    camera0: np.ndarray | None = None,
    camera1: np.ndarray | None = None,
    confidence: float | None = None,
    iterations: int | None = None,
    seed: int | None = None,
    guided_options: GuidedOptions | None = None,
    progress: Callable[[str], object] | None = None,
) -> Matches:
    """Detect and match the keypoints of two images.

    Every option that is None is as in `options`, or in the preset.

    Args:
        image0, image1: anything `load_image` takes.
        detector: a `DeepDetect`, or anything with its `heatmap` method; default `DeepDetect()`.
        channels: order of the colours in images that are arrays, as of `load_image`: "bgr" for
            those of OpenCV.
        preset: name of the options to start from: "default", or "published" for exactly
            what the paper's published code does, whatever the detector's own resolution
            and order of the colours.
        options: all options at once, instead of a preset.
        initial: sparse matches of the pair, where `initial_matches` has made them already.
        seeds: sparse matches of any other matcher (LightGlue, LoFTR, a person's clicks), two (K, 2)
            arrays of positions, row by row; they take the place of our own SIFT matches. Some may
            be wrong.
        guided: whether a geometry from a few matches guides the matching, or descriptors alone
            decide.
        model: the geometry, "homography" (planes, pure rotation), "fundamental" (any static
            scene), "essential" (with `camera0` and `camera1`), "auto" (one of the first two) or
            "none"; it also chooses what guides.
        guide: which geometry guides where `model` leaves it open: "auto", "homography" or
            "fundamental".
        mutual: keep only mutual nearest neighbours; guided, the best match of each keypoint, and
            the same matches whichever image comes first.
        threshold, density, max_keypoints, nms_radius, subpixel, ignore, mode, spread: which pixels
            or points become keypoints (`SelectionOptions`). With `max_keypoints` alone they are
            the best ones of all scales, which need no network.
        resolution, network_channels: how the network sees the images (`HeatmapOptions`).
        descriptor, keypoint_size, angle, matcher, ratio: of matches by descriptors alone; they do
            not apply to guided ones (`MatchingOptions`).
        estimator, inlier_threshold, homography, camera0, camera1, confidence, iterations, seed:
            how the geometry is estimated (`GeometryOptions`).
        guided_options: all tuned numbers of guided matching.
        progress: called with the name of each stage when it ends.

    Returns:
        The matches, the geometry, and which agree with it. Where guided matching can trust no
        geometry there are none (`Matches.lost`), and the keypoints are found when they are first
        asked for; `guided=False` matches by descriptors alone.

    Raises:
        ImageError: an image cannot be read or is not fit.
        OptionError: an option is unknown or out of its range.
        MissingExtraError: guided matching needs numba, and it is not installed.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64), np.uint8).repeat(2, 0).repeat(2, 1)
        >>> matches = match_images(image, image, model="homography")
        >>> bool((matches.points0 == matches.points1).all())
        True
    """
    chosen = options if options is not None else get_preset(preset)
    if chosen.heatmap is None and not (resolution is None and network_channels is None):
        own = getattr(detector, "heatmap_options", HeatmapOptions())
        chosen = dataclasses.replace(chosen, heatmap=own)
    given = {
        "guided": guided,
        "model": model,
        "guide": guide,
        "mutual": mutual,
        "threshold": threshold,
        "density": density,
        "max_keypoints": max_keypoints,
        "nms_radius": nms_radius,
        "subpixel": subpixel,
        "ignore": ignore,
        "mode": mode,
        "spread": spread,
        "resolution": resolution,
        "network_channels": network_channels,
        "descriptor": descriptor,
        "keypoint_size": keypoint_size,
        "angle": angle,
        "matcher": matcher,
        "ratio": ratio,
        "estimator": estimator,
        "inlier_threshold": inlier_threshold,
        "homography": homography,
        "camera0": camera0,
        "camera1": camera1,
        "confidence": confidence,
        "iterations": iterations,
        "seed": seed,
        "guided_options": guided_options,
    }
    chosen = replace_options(
        chosen, **{name: value for name, value in given.items() if value is not None}
    )
    if seeds is not None and not chosen.guided:
        raise OptionError("seeds guide the matching: leave them out, or guided=False")
    timer = StageTimer(progress)
    rgb = load_image(image0, channels=channels), load_image(image1, channels=channels)
    detector = _configured(detector, chosen.heatmap)
    grays = luma(rgb[0]), luma(rgb[1])
    pair = _GuidedPair(grays, initial, seeds).ordered(chosen.mutual) if chosen.guided else None
    first: InitialGeometry | None = None
    if pair is not None and _can_wait(detector, chosen):
        with timer.stage("initial geometry"):
            first = pair.geometry(chosen)
        if first.matrix is None:
            return _lost_matches(first.as_guide(), detector, rgb, chosen, timer)
    with timer.stage("keypoints"):
        keypoints = [find_keypoints(detector, image, chosen.selection) for image in rgb]
    found_guide, guided_pair = None, None
    rows: tuple[Any, Any]  # of the keypoints, None where they are looked up
    if pair is not None:
        with timer.stage("guided matching"):
            found_guide, guided_pair, positions, rows = _match_guided(
                pair, keypoints, chosen, first
            )
        points0, points1, scores = positions
    else:
        found = unguided_matches(grays, keypoints, chosen, timer)
        points0, points1 = keypoints[0].xy[found.rows0], keypoints[1].xy[found.rows1]
        scores = np.clip(1 - found.ratios, 0, 1)
        rows = found.rows0, found.rows1
    with timer.stage("geometry"):
        geometry = _final_geometry(points0, points1, chosen.geometry, found_guide)
    return Matches(
        points0,
        points1,
        scores,
        geometry.inliers,
        geometry.model,
        geometry.matrix,
        keypoints[0],
        keypoints[1],
        timer.seconds,
        found_guide,
        guided_pair is not None and guided_pair.subpixel,
        *rows,
    )


@dataclass(frozen=True, eq=False)
class _GuidedPair:
    """Two images whose matching is guided, and sparse matches of them that are known."""

    grays: tuple[np.ndarray, np.ndarray]
    initial: InitialMatches | None
    seeds: tuple[np.ndarray, np.ndarray] | None
    swapped: bool = False

    def ordered(self, mutual: bool) -> _GuidedPair:
        """Return the pair in the order in which it is matched, which with `mutual` is its own."""
        if not (mutual and _comes_after(*self.grays)):
            return self
        initial = None if self.initial is None else self.initial.swapped()
        seeds = None if self.seeds is None else self.seeds[::-1]
        return _GuidedPair(self.grays[::-1], initial, seeds, not self.swapped)

    def geometry(self, options: MatchingOptions) -> InitialGeometry:
        """Return the geometry to begin with, without any keypoint of ours."""
        return guiding_geometry(
            *self.grays,
            options.guiding_model,
            options.geometry.seed,
            self.initial,
            options.guided_options,
            self.seeds,
        )


def _can_wait(detector: HeatmapDetector, options: MatchingOptions) -> bool:
    """Whether keypoints take no part in the first geometry, and finding them cannot fail.

    Points of all scales take part in it; what is wrong with the caller's own detector or mask must
    be said at once.
    """
    own = isinstance(detector, DeepDetect) and options.selection.ignore is None
    return own and not options.selection.uses_points


def _lost_matches(
    guide: Guide,
    detector: HeatmapDetector,
    rgb: tuple[np.ndarray, np.ndarray],
    options: MatchingOptions,
    timer: StageTimer,
) -> Matches:
    """Return no matches; nobody may ever ask for the keypoints, which need the network."""
    nothing, nowhere = np.empty(0, np.float32), np.empty((0, 2), np.float32)
    keypoints = [
        found_later(partial(find_keypoints, detector, image, options.selection)) for image in rgb
    ]
    return Matches(
        *(nowhere, nowhere, nothing, nothing, "none", None),
        keypoints[0],
        keypoints[1],
        timer.seconds,
        guide=guide,
    )


def _match_guided(
    pair: _GuidedPair,
    keypoints: Sequence[Keypoints],
    options: MatchingOptions,
    geometry: InitialGeometry | None,
) -> tuple[
    Guide,
    GuidedMatches | None,
    tuple[np.ndarray, np.ndarray, np.ndarray],
    tuple[Any, Any],
]:
    """Return what guided, the matches, their positions with their scores, and their keypoints."""
    first, second = keypoints[::-1] if pair.swapped else keypoints
    guide, found = guided_matches(
        *pair.grays,
        np.rint(first.xy),
        np.rint(second.xy),
        options.guiding_model,
        options.geometry.seed,
        pair.initial,
        options.guided_options,
        pair.seeds,
        (first, second),
        geometry,
    )
    if found is not None and options.mutual:
        found = found.unique()
    points0, points1, scores = _guided_points(found, (first, second))
    rows0, rows1 = (None, None) if found is None else (found.rows0, found.rows1)
    if pair.swapped:
        return guide.swapped(), found, (points1, points0, scores), (rows1, rows0)
    return guide, found, (points0, points1, scores), (rows0, rows1)


def _comes_after(gray0: np.ndarray, gray1: np.ndarray) -> bool:
    """Order images by what is in them, so that a pair and the swapped pair are matched alike."""
    keys = [(gray.shape, hashlib.sha256(gray.tobytes()).digest()) for gray in (gray0, gray1)]
    return keys[0] > keys[1]


def _guided_points(
    found: GuidedMatches | None, keypoints: Sequence[Keypoints]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions in both images and scores; none where no geometry could be trusted."""
    if found is None:
        nowhere = np.empty((0, 2), np.float32)
        return nowhere, nowhere, np.empty(0, np.float32)
    points0 = keypoints[0].xy[found.rows0]
    if found.rows1 is not None:
        return points0, keypoints[1].xy[found.rows1], found.scores
    # What is not at a keypoint of the second image is where the pixel of the first one is seen.
    return np.rint(points0), found.points1.astype(np.float32), found.scores


def _final_geometry(
    points0: np.ndarray, points1: np.ndarray, options: GeometryOptions, guide: Guide | None
) -> Geometry:
    """Return the guide's own geometry where that is asked for, else estimate one."""
    if guide is None or options.homography is not None:
        return estimate_geometry(points0, points1, options)
    if guide.matrix is None:
        return Geometry("none", None, np.zeros(len(points0), bool))
    if options.model in ("auto", guide.model):
        errors_of = transfer_errors if guide.model == "homography" else epipolar_errors
        errors = errors_of(points0, points1, guide.matrix)
        return Geometry(guide.model, guide.matrix, errors < options.inlier_threshold)
    return estimate_geometry(points0, points1, options)


def _configured(
    detector: HeatmapDetector | None, heatmap: HeatmapOptions | None
) -> HeatmapDetector:
    """Return the detector that sees images the way the options ask for."""
    if detector is None:
        detector = DeepDetect()
    if heatmap is None:
        return detector
    if not isinstance(detector, DeepDetect):
        raise OptionError(
            "these options fix how the network sees the image, which only a DeepDetect "
            "detector can follow: use it, or set heatmap to None"
        )
    return detector.configured(heatmap)
