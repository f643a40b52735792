"""Matched keypoints of two images, and the geometry between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.opencv import cv2
from .._shared.options import numbers_of, suggest_keywords, whole
from ..geometry.estimation import MAX_LOG10_NFA, Geometry, GeometryOptions, log10_nfa
from .keypoints import Keypoints, nearest_keypoints

MAX_KEYPOINT_DISTANCE_PX = 1.0
"""The keypoint at an end of a match is the nearest one within this distance. Chosen by hand."""

_COLUMNS: dict[str, Any] = {
    "points0": np.float32,
    "points1": np.float32,
    "scores": np.float32,
    "inliers": np.bool_,
}


@suggest_keywords
@dataclass(frozen=True, eq=False)
class Evidence:
    """Why a geometry between two images is trusted, or not.

    Attributes:
        tentative_matches: number of tentative matches from which the geometry was first estimated.
        tentative_inliers: number of tentative matches that agree with the geometry.
        log10_nfa: decimal logarithm of the geometry's number of false alarms (a contrario): the
            expected number of geometries with as many inliers among random matches.
        simulated_views: number of views that were simulated to find the geometry, as in ASIFT.
        on_plane, off_plane: number of matches on and off the dominant plane, if there is one.
        verified: fraction of the overlap where the images, aligned by the geometry, are more
            similar than nearly all places of images that are shifted against each other.
        agreement: fraction of the places with structure where images do not contradict the model.
        correlation: median correlation of the descriptors of both images at places with structure.
            In a scene with depth, the matches around a place predict its position in the second
            image; the place's own matches are left out. 0 if there are few matches.
        left_out: fraction of the image that was left out, because it stays in place while the scene
            moves: a frame, a caption, a logo, or the vehicle that carries the camera.
    """

    tentative_matches: int = 0
    tentative_inliers: int = 0
    log10_nfa: float = np.inf
    simulated_views: int = 0
    on_plane: int = 0
    off_plane: int = 0
    verified: float = 0.0
    agreement: float = 0.0
    correlation: float = 0.0
    left_out: float = 0.0


@suggest_keywords
@dataclass(frozen=True, eq=False)
class Layer:
    """One of several geometries of an image pair: of the scene, or of an object that moves.

    Attributes:
        model: "homography" or "fundamental".
        matrix: (3, 3) float64, as in `TwoViewGeometry`.
        share: fraction of the images' overlap that fits this geometry, as `Evidence.verified`; 0 if
            only sparse matches support the geometry.
    """

    model: str
    matrix: np.ndarray
    share: float

    def swapped(self) -> Layer:
        """Return the geometry from the second image to the first."""
        return replace(self, matrix=_swapped(self.model, self.matrix))


@suggest_keywords
@dataclass(frozen=True, eq=False)
class TwoViewGeometry:
    """The geometry between two images.

    Attributes:
        model: "homography", "fundamental", "essential", or "none" if no geometry can be trusted.
        matrix: (3, 3) float64; None if the model is "none". A homography maps points of the first
            image to the second. Other matrices M satisfy x1^T M x0 = 0 for points x0 and x1 of the
            two images, in pixels or, for an essential matrix, in normalised coordinates.
        scene: "still" (both images show the same view), "planar", "rotation" (the camera only
            rotated; a flat scene may look the same), "depth", "depth with a dominant plane", or
            "none" if the model is "none". If the cameras are calibrated, matches of a planar scene
            leave two possible poses, and matches of a rotation do not tell the translation.
        confidence: "high", "fair" (only sparse matches, or weak evidence), or "none" if the model
            is "none".
        evidence: the measurements on which the decision rests.
        layers: the geometries that guided matching found. The first is that of the scene, which
            covers most of the images; the others are of moving objects. See `Matches.layer`.
    """

    model: str
    matrix: np.ndarray | None = None
    scene: str = "none"
    confidence: str = "none"
    evidence: Evidence = field(default_factory=Evidence)
    layers: tuple[Layer, ...] = ()

    def swapped(self) -> TwoViewGeometry:
        """Return the geometry from the second image to the first."""
        matrix = None if self.matrix is None else _swapped(self.model, self.matrix)
        layers = tuple(layer.swapped() for layer in self.layers)
        return replace(self, matrix=matrix, layers=layers)


def _swapped(model: str, matrix: np.ndarray) -> np.ndarray:
    if model != "homography":
        return matrix.T
    inverse = np.linalg.inv(matrix)
    return np.asarray(inverse / inverse[2, 2])


@dataclass(frozen=True, eq=False)
class GuidedMatches:
    """Matches from keypoints of the first image to positions in the second, by guided matching.

    Attributes:
        indices0: (M,) int64 rows of the keypoints of the first image, ascending, each once.
        points1: (M, 2) float64 positions in the second image.
        scores: (M,) float32 in [0, 1], higher is better.
        subpixel: whether `points1` are sub-pixel positions, as from a rectified pair.
        indices1: (M,) int64 rows of the keypoints at `points1`; None if `points1` are no keypoints.
        points0: (M, 2) float64 positions in the first image, if they are not keypoints; otherwise
            None. With `points0`, a match without a keypoint near it has -1 in `indices0`.
        alike: (M,) bool, False if the images contradict a match. Surrounding matches predict where
            the second image shows the window around a match in the first image; in contradicted
            matches, the window is no more similar to that place than to unrelated windows.
        layer: (M,) int8 index of the geometry that a match follows (`TwoViewGeometry.layers`).
    """

    indices0: np.ndarray
    points1: np.ndarray
    scores: np.ndarray
    subpixel: bool = False
    indices1: np.ndarray | None = None
    points0: np.ndarray | None = None
    alike: np.ndarray | None = None
    layer: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.indices0)

    def starts(self, xy0: np.ndarray) -> np.ndarray:
        """Return the (M, 2) positions in the first image; its keypoints lie at `xy0`."""
        return xy0[self.indices0] if self.points0 is None else self.points0

    def chosen(self, rows: np.ndarray) -> GuidedMatches:
        """Return the matches in the chosen rows, without `points0`, `alike` and `layer`."""
        indices1 = None if self.indices1 is None else self.indices1[rows]
        columns = self.indices0[rows], self.points1[rows], self.scores[rows]
        return GuidedMatches(*columns, self.subpixel, indices1)

    def joined(self, other: GuidedMatches, chosen: np.ndarray) -> GuidedMatches:
        """Return these matches and those of `other` that the mask `chosen` selects."""
        order = np.argsort(np.append(self.indices0, other.indices0[chosen]), kind="stable")

        def both(name: str) -> np.ndarray:
            return np.concatenate([getattr(self, name), getattr(other, name)[chosen]])[order]

        indices1 = None if self.indices1 is None or other.indices1 is None else both("indices1")
        columns = both("indices0"), both("points1"), both("scores")
        return GuidedMatches(*columns, self.subpixel, indices1)


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Matches:
    """Matched keypoints of two images.

    Attributes:
        points0, points1: (M, 2) float32 positions in the first and in the second image, matched row
            by row, in pixels; the centre of the first pixel is (0, 0). If a fundamental matrix
            guided the matching, `points0` are pixels with keypoints, and `points1` the places where
            the second image shows these pixels; with `mutual`, the images may have swapped these
            roles. Otherwise all positions are keypoints.
        scores: (M,) float32 in [0, 1], higher is better. If geometry guided the matching,
            the correlation of both patches or of their descriptors. Otherwise, 1 - Lowe's ratio.
        inliers: (M,) bool, the matches whose error under the geometry is below
            `GeometryOptions.inlier_threshold`; all matches if there is no geometry yet. Guided
            matches that the surrounding image contradicts are not inliers.
        keypoints0, keypoints1: all keypoints of the two images.
        seconds: time of each stage of the matching, for both images together, by the stage's name.
        geometry: the geometry between the images; None for `match_features`, which estimates none.
        subpixel: whether the matching itself found sub-pixel positions in the second image, on the
            rectified pair. These positions need no refinement.
        indices0, indices1: (M,) int32 rows of the matched keypoints in `keypoints0` and
            `keypoints1`. If a fundamental matrix guided the matching, `indices0` is the keypoint on
            whose pixel a match starts, and `indices1` the keypoint nearest to its end, up to a
            pixel away, or -1 (`m[m.indices1 >= 0]` drops matches without a keypoint); with
            `mutual`, these roles may be swapped. None: the nearest keypoints are looked up.
        layer: (M,) int8 index in `geometry.layers` of the geometry that a match follows; -1 (or
            None for all) without layers. `m[m.layer == 0]` has the matches of the scene.
        covariances: (M, 2, 2) float32 covariances of `points1` relative to `points0`, in square
            pixels, from `refine_matches`; otherwise None.

    With the same options, an index means the same keypoint in all pairs with this image, because
    keypoints do not depend on the other image. So matches of several pairs can be joined to tracks.

    `len` and indexing by slices, masks, index arrays and whole numbers work: `m[m.inliers]`.

    Raises:
        OptionError: the shapes do not fit together, or an index belongs to no keypoint.

    Example:
        >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
        >>> ends = points.xy, points.xy
        >>> m = Matches(*ends, [0.5, 0.2], [True, False], points, points)
        >>> m
        Matches(2 matches of 2 and 2 keypoints, 1 inliers)
        >>> m[m.inliers].pairs.tolist()
        [[0, 0]]
    """

    points0: np.ndarray
    points1: np.ndarray
    scores: np.ndarray
    inliers: np.ndarray
    keypoints0: Keypoints
    keypoints1: Keypoints
    seconds: dict[str, float] = field(default_factory=dict)
    geometry: TwoViewGeometry | None = None
    subpixel: bool = False
    indices0: np.ndarray = None  # type: ignore[assignment]  # never None after construction
    indices1: np.ndarray = None  # type: ignore[assignment]
    layer: np.ndarray = None  # type: ignore[assignment]
    covariances: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, dtype in _COLUMNS.items():
            columns = 2 if name.startswith("points") else None
            values = numbers_of(name, getattr(self, name), dtype, columns)
            object.__setattr__(self, name, values if columns else values.ravel())
        counts = [len(self.points0), len(self.points1), len(self.scores), len(self.inliers)]
        if len(set(counts)) > 1:
            raise OptionError(
                f"matches need equally many points0, points1, scores and inliers, not {counts}"
            )
        if not (np.isfinite(self.points0).all() and np.isfinite(self.points1).all()):
            raise OptionError("matches need finite positions: leave out the other matches")
        for side in (0, 1):
            name = f"indices{side}"
            indices = getattr(self, name)
            # Without matches, keypoints that are detected on first access stay undetected.
            keypoints: Any = getattr(self, f"keypoints{side}") if len(self) else ()
            if indices is None and len(self):
                indices, distances = nearest_keypoints(
                    getattr(self, f"points{side}"), keypoints.xy, keypoints.image_size
                )
                indices[distances > MAX_KEYPOINT_DISTANCE_PX] = -1
            indices = numbers_of(name, () if indices is None else indices, None)
            if indices.shape != (len(self),) or (indices.size and indices.dtype.kind not in "iu"):
                raise OptionError(
                    f"matches need one whole number per match in {name}, not {indices.dtype} "
                    f"numbers of shape {indices.shape}"
                )
            count = len(keypoints)
            if indices.size and not (indices.min() >= -1 and indices.max() < count):
                raise OptionError(
                    f"{name} must lie in [-1, {count - 1}], as there are {count} keypoints, not in "
                    f"[{indices.min()}, {indices.max()}]"
                )
            object.__setattr__(self, name, indices.astype(np.int32))
        layer = (
            np.full(len(self), -1) if self.layer is None else numbers_of("layer", self.layer, None)
        )
        if layer.shape != (len(self),):
            raise OptionError(f"matches need one number per match in layer, not {layer.shape}")
        object.__setattr__(self, "layer", layer.astype(np.int8))
        if self.covariances is not None:
            covariances = numbers_of("covariances", self.covariances, np.float32)
            if covariances.shape != (len(self), 2, 2):
                raise OptionError(
                    f"matches need a 2x2 matrix per match in covariances, not {covariances.shape}"
                )
            object.__setattr__(self, "covariances", covariances)

    def __getstate__(self) -> dict[str, Any]:
        # The pickled state holds the keypoints themselves, not functions that detect them.
        return {**self.__dict__, "keypoints0": self.keypoints0, "keypoints1": self.keypoints1}

    @property
    def success(self) -> bool:
        """False if no geometry between the images can be trusted (its model is "none")."""
        return self.geometry is None or self.geometry.model != "none"

    @property
    def pairs(self) -> np.ndarray:
        """(K, 2) uint32 rows of `keypoints0` and `keypoints1`: matches as in COLMAP and kornia.

        Matches with an end that is not a keypoint are left out.
        """
        found = np.column_stack([self.indices0, self.indices1])
        return found[(found >= 0).all(axis=1)].astype(np.uint32)

    @suggest_keywords
    def with_geometry(self, found: Geometry, inlier_threshold: float = 1.0) -> Matches:
        """Return the same matches with a geometry from `estimate_geometry`, and its evidence.

        The geometry has the confidence "fair" if its inliers are too many to be due to chance.
        Otherwise it has the model "none", and no match is an inlier.

        Args:
            found: the geometry that was estimated from these matches.
            inlier_threshold: the threshold, in pixels, with which the geometry was estimated.
        """
        GeometryOptions(inlier_threshold=inlier_threshold)
        alarms = np.inf
        if found.matrix is not None:
            size = self.keypoints1.image_size
            alarms = log10_nfa(found.inliers, found.model, inlier_threshold, size)
        agreeing = int(np.count_nonzero(found.inliers))
        evidence = Evidence(len(self), agreeing, alarms)
        if alarms >= MAX_LOG10_NFA:
            nothing = TwoViewGeometry("none", evidence=evidence)
            return replace(self, geometry=nothing, inliers=np.zeros(len(self), bool))
        scene = "planar" if found.model == "homography" else "depth"
        geometry = TwoViewGeometry(found.model, found.matrix, scene, "fair", evidence)
        return replace(self, geometry=geometry, inliers=found.inliers)

    def to_opencv(self) -> list[cv2.DMatch]:
        """Convert to OpenCV's matches of `keypoints0.to_opencv()` and `keypoints1.to_opencv()`.

        The distance of a match is 1 - its score. Matches without a keypoint at an end are left out.

        Example:
            >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
            >>> ends = points.xy, points.xy[::-1]
            >>> m = Matches(*ends, [0.5, 0.2], [True, True], points, points)
            >>> [(match.queryIdx, match.trainIdx) for match in m.to_opencv()]
            [(0, 1), (1, 0)]
        """
        columns = self.indices0.tolist(), self.indices1.tolist(), (1 - self.scores).tolist()
        return [cv2.DMatch(i, j, d) for i, j, d in zip(*columns, strict=True) if min(i, j) >= 0]

    def unique(self) -> Matches:
        """Return one-to-one matches: each has the highest score of all matches at both its ends.

        An end is a keypoint or, without one, a pixel. Among equal scores the first match is kept.

        Example:
            >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
            >>> ends = points.xy[[0, 0, 1]], points.xy[[1, 0, 1]]
            >>> m = Matches(*ends, [0.5, 0.9, 0.3], [True] * 3, points, points)
            >>> m.unique().points1.tolist()
            [[1.0, 2.0]]
        """
        kept = np.ones(len(self), bool)
        best_first = np.argsort(-self.scores, kind="stable")
        for side in (0, 1):
            ends = getattr(self, f"indices{side}").astype(np.int64)
            without = np.flatnonzero(ends < 0)  # ends without a keypoint
            pixels = np.floor(getattr(self, f"points{side}")[without] + np.float32(0.5))
            pixels = np.unique(pixels.astype(np.int64), axis=0, return_inverse=True)[1]
            ends[without] = -1 - pixels.reshape(-1)
            best = np.unique(ends[best_first], return_index=True)[1]
            is_best = np.zeros(len(self), bool)
            is_best[best_first[best]] = True
            kept &= is_best
        return self[kept]

    def swapped(self) -> Matches:
        """Return the same matches from the second image to the first, without covariances."""
        geometry = self.geometry
        return replace(
            self,
            points0=self.points1,
            points1=self.points0,
            keypoints0=self.keypoints1,
            keypoints1=self.keypoints0,
            geometry=None if geometry is None else geometry.swapped(),
            indices0=self.indices1,
            indices1=self.indices0,
            covariances=None,
        )

    @suggest_keywords
    def draw(
        self,
        image0: Any,
        image1: Any,
        *,
        channels: Channels = "rgb",
        lines: int = 150,
        by_position: bool = False,
    ) -> np.ndarray:
        """Draw matches as lines on both images side by side: inliers in green, outliers in red.

        Args:
            image0, image1: arrays, PyTorch tensors or PIL images.
            channels: order of the colours in arrays and tensors.
            lines: maximum number of matches that are drawn: a random sample, always the same.
            by_position: colour inliers by their position in the first image, which shows what was
                matched where. Most inliers are then drawn as dots, without a line.

        Returns:
            (H, W, 3) uint8 RGB, its longer side at most 2,000 pixels.

        Raises:
            ImageError: the size of an image differs from the `image_size` of its keypoints.
        """
        from ..viz.draw import draw_matches
        from .display import checked_image

        rgb0 = checked_image(image0, self.keypoints0.image_size, channels)
        rgb1 = checked_image(image1, self.keypoints1.image_size, channels)
        ends = self.points0, self.points1, self.inliers
        return draw_matches(rgb0, rgb1, *ends, whole("lines", lines), by_position=by_position)

    def __len__(self) -> int:
        return len(self.points0)

    def __getitem__(self, index: slice | np.ndarray | Sequence[int] | int) -> Matches:
        rows = [int(index)] if isinstance(index, (int, np.integer)) else index
        names = [*_COLUMNS, "indices0", "indices1", "layer"]
        names += [] if self.covariances is None else ["covariances"]
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def _repr_html_(self) -> str:
        from .display import html_summary

        inliers, geometry = np.count_nonzero(self.inliers), self.geometry
        rows = {"inliers": f"{inliers:,}"}
        if geometry is not None:
            told = f"{geometry.model}, confidence: {geometry.confidence}"
            rows["geometry"] = told if self.success else "none that can be trusted"
        for side, keypoints in enumerate((self.keypoints0, self.keypoints1)):
            width, height = keypoints.image_size
            rows[f"image {side}"] = f"{width}x{height}, {len(keypoints):,} keypoints"
        if len(self):
            rows["scores"] = f"{self.scores.min():.3g} to {self.scores.max():.3g}"
        if self.seconds:
            rows["seconds"] = f"{sum(self.seconds.values()):.2f}"
        ends = [self.points0, self.points1]
        sizes = [self.keypoints0.image_size, self.keypoints1.image_size]
        lines = np.hstack(ends)[self.inliers if inliers else slice(None)]
        points = list(zip(ends, sizes, strict=True))
        return html_summary(f"{len(self):,} matches", rows, points, lines)

    def __repr__(self) -> str:
        if not self.success:  # the keypoints may not be detected yet
            return f"Matches({len(self)} matches; no geometry can be trusted)"
        told = ""
        if self.geometry is not None:
            told = f", model={self.geometry.model!r}, confidence={self.geometry.confidence!r}"
        return (
            f"Matches({len(self)} matches of {len(self.keypoints0)} and {len(self.keypoints1)} "
            f"keypoints, {np.count_nonzero(self.inliers)} inliers{told})"
        )
