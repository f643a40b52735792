"""Matching two images: keypoints, descriptors, ratio test, geometry (paper, Section III-C)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from .._shared.errors import OptionError
from .._shared.memory import free_memory
from .._shared.options import changed
from ..detector.detector import DeepDetect, find_keypoints
from ..detector.heatmap import HeatmapOptions
from ..features.descriptors import get_descriptor
from ..features.keypoints import Keypoints
from ..features.matchers import DescriptorMatches, get_matcher, match_descriptors, one_to_one
from ..geometry import Geometry, GeometryOptions, estimate_geometry
from ..geometry.residuals import transfer_errors
from ..io.image import load_image, luma
from .guided import Guidance, guided_matches
from .guided.initial_geometry import InitialMatches
from .options import MatchingOptions, get_preset

BYTES_A_KEYPOINT = 1500
"""Memory that matching takes: 128 float32 of the descriptor, twice with FLANN's trees and copy."""

GUIDING_MODELS = {
    "homography": "homography",
    "fundamental": "fundamental",
    "essential": "fundamental",
}
"""Geometries that guide when they are asked for; any other model leaves the choice open."""


class HeatmapDetector(Protocol):
    """What `match_images` asks of a detector."""

    def heatmap(self, image: Any) -> np.ndarray:
        """Map an image to a (H, W) float32 probability of a keypoint."""
        ...


@dataclass(frozen=True, eq=False)
class Matches:
    """Matched keypoints of two images.

    Attributes:
        points0, points1: (M, 2) float32 positions in the first and in the second
            image, matched row by row; centre of the first pixel (0, 0).
        ratios: (M,) float32: small is sure. Unguided, the distance to the best over that to the
            second-best descriptor; guided (`guided`), the distance over that of strangers.
        model: (3, 3) float64 geometry between the images, or None.
        inliers: (M,) bool, the matches that agree with the model.
        kind: what `model` is: "homography", "fundamental", "essential" or "none".
        keypoints0, keypoints1: all keypoints of the two images.
        seconds: time of each stage, both images together.
        guidance: what guided the matching; None when no guidance was asked for. With the kind
            "none" no geometry could be trusted, and the matches are unguided.
    """

    points0: np.ndarray
    points1: np.ndarray
    ratios: np.ndarray
    model: np.ndarray | None
    inliers: np.ndarray
    kind: str
    keypoints0: Keypoints
    keypoints1: Keypoints
    seconds: dict[str, float] = field(default_factory=dict)
    guidance: Guidance | None = None

    @property
    def guided(self) -> bool:
        """Whether a geometry proposed these matches."""
        return self.guidance is not None and self.guidance.kind != "none"

    def __len__(self) -> int:
        return len(self.points0)


def match_images(
    image0: Any,
    image1: Any,
    detector: HeatmapDetector | None = None,
    *,
    preset: str = "default",
    options: MatchingOptions | None = None,
    initial: InitialMatches | None = None,
    **changes: Any,
) -> Matches:
    """Detect and match the keypoints of two images.

    Args:
        image0, image1: anything `DeepDetect.heatmap` takes.
        detector: a `DeepDetect`, or anything with its `heatmap` method; default
            `DeepDetect()` with the bundled weights.
        preset: name of the options to start from: "default", or "published" for exactly
            what the paper's published code does, whatever the detector's own resolution
            and channels.
        options: all options at once, instead of a preset.
        initial: sparse matches of the pair, where `initial_matches` has made them already.
        **changes: single options by name: those of `MatchingOptions`, `SelectionOptions`
            and `GeometryOptions`, as `mutual=True, density=0.1, model="homography"`. The
            options `descriptor`, `keypoint_size`, `angle`, `matcher` and `ratio` have a say only
            in unguided matching: with `guidance="none"`, or where no geometry can be trusted.

    Returns:
        The matches, the geometry, and which agree with it. Guided they are those that look alike
        where the geometry points, unguided those that pass the ratio test.

    Raises:
        ImageError: an image cannot be read or is not fit.
        OptionError: an option is unknown or out of its range.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> image = rng.integers(0, 256, (64, 64), np.uint8).repeat(2, 0).repeat(2, 1)
        >>> matches = match_images(image, image, model="homography", matcher="exact")
        >>> bool((matches.points0 == matches.points1).all())
        True
    """
    chosen = changed(options if options is not None else get_preset(preset), **changes)
    seconds: dict[str, float] = {}
    rgb = load_image(image0), load_image(image1)
    detector = _configured(detector, chosen.heatmap)
    with _timed(seconds, "keypoints"):
        keypoints = [find_keypoints(detector, image, chosen.selection) for image in rgb]
    grays = luma(rgb[0]), luma(rgb[1])
    guidance, found = None, None
    if chosen.guidance != "none":
        with _timed(seconds, "guided matching"):
            guidance, found = guided_matches(
                *grays,
                *(np.rint(points.xy) for points in keypoints),
                _guiding_model(chosen),
                chosen.geometry.seed,
                initial,
            )
    if found is None:
        found = unguided_matches(grays, [points.xy for points in keypoints], chosen, seconds)
    elif chosen.mutual:
        found = one_to_one(found)
    points0 = keypoints[0].xy[found.rows0]
    points1 = keypoints[1].xy[found.rows1]
    with _timed(seconds, "geometry"):
        geometry = _geometry(points0, points1, chosen.geometry, guidance)
    return Matches(
        points0,
        points1,
        found.ratios,
        geometry.matrix,
        geometry.inliers,
        geometry.kind,
        *keypoints,
        seconds,
        guidance,
    )


def unguided_matches(
    grays: Sequence[np.ndarray],
    points: Sequence[np.ndarray],
    chosen: MatchingOptions,
    seconds: dict[str, float],
) -> DescriptorMatches:
    """Match all descriptors with all others.

    Args:
        grays: (H, W) uint8 luma of both images.
        points: (N, 2) float32 keypoints of both.
        chosen: the options; their guidance is not looked at.
        seconds: takes the time of each stage.

    Raises:
        OptionError: there are too many keypoints for the memory.
    """
    check_memory([len(xy) for xy in points])
    with _timed(seconds, "descriptors"):
        describe = get_descriptor(chosen.descriptor)
        descriptors = [
            describe(gray, xy, chosen.keypoint_size, chosen.angle)
            for gray, xy in zip(grays, points, strict=True)
        ]
    with _timed(seconds, "matching"):
        return match_descriptors(
            *descriptors,
            get_matcher(chosen.matcher),
            ratio=chosen.ratio,
            mutual=chosen.mutual,
            seed=chosen.geometry.seed,
            positions=(np.rint(points[0]), np.rint(points[1])),
        )


def _guiding_model(chosen: MatchingOptions) -> str:
    """What is asked for guides, where nothing else is said: a plane would drop all depth."""
    if chosen.guidance != "auto":
        return chosen.guidance
    return GUIDING_MODELS.get(chosen.geometry.model, "auto")


def _geometry(
    points0: np.ndarray, points1: np.ndarray, options: GeometryOptions, guidance: Guidance | None
) -> Geometry:
    """Take the geometry that guided where that is what is asked for, else estimate it."""
    known = guidance is not None and guidance.kind == "homography"
    if known and options.model in ("auto", "homography") and options.homography is None:
        assert guidance is not None
        assert guidance.matrix is not None
        errors = transfer_errors(points0, points1, guidance.matrix)
        return Geometry("homography", guidance.matrix, errors < options.inlier_threshold)
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


def check_memory(keypoints: Sequence[int]) -> None:
    """Stop before the descriptors and their search trees fill the memory.

    Args:
        keypoints: how many there are in each image.

    Raises:
        OptionError: there are too many.
    """
    needed = sum(keypoints) * BYTES_A_KEYPOINT
    if needed > free_memory():
        raise OptionError(
            f"{' and '.join(f'{count:,}' for count in keypoints)} keypoints need about "
            f"{needed / 1e9:.0f} GB of memory to be matched: make them fewer with "
            "max_keypoints, density, or a smaller resolution"
        )


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    started = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - started
