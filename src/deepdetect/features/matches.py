"""Matched keypoints of two images, and the geometry between them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, cast

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.opencv import cv2
from .._shared.options import numbers_of, suggest_keywords, whole
from .keypoints import Keypoints, nearest_keypoints

MAX_KEYPOINT_DISTANCE_PX = 1.0
"""Of a position from the keypoint that it belongs to."""

_COLUMNS: dict[str, Any] = {
    "points0": np.float32,
    "points1": np.float32,
    "scores": np.float32,
    "inliers": np.bool_,
}


@suggest_keywords
@dataclass(frozen=True, eq=False)
class TwoViewGeometry:
    """The geometry that guided the matching of two images.

    Attributes:
        model: "homography", "fundamental", or "none": no geometry is trusted, no matches.
        matrix: (3, 3) float64, refined, of the first image to the second; None without one.
        tentative_matches: number of tentative matches that it was first estimated from.
        tentative_inliers: number of those that agree with it, and of more along its lines.
        log10_nfa: decimal logarithm of its number of false alarms (a contrario).
        simulated_views: number of views that were simulated to find it, as in ASIFT.
        scene: "planar", "rotation" (a turning camera explains the homography as well; a flat scene
            may look so), "depth", "depth with a dominant plane", or "none". Matches of a planar
            scene tell two poses from known cameras, those of a rotation no translation.
        on_plane, off_plane: number of matches on the plane that most of them lie on, where there
            is one, and of the others.
        verified: fraction of what it proposed that the images confirm: of a homography the partners
            of keypoints, else the keypoints of the first image that are matched, or, where only
            sparse matches are returned, these.
        correlation: median ZNCC of windows of both images, each where the matches around it say,
            without its own: right matches predict what looks alike. 0 for few matches.
        confidence: "high", "fair" (only sparse matches, or weak evidence) or "none".
    """

    model: str
    matrix: np.ndarray | None
    tentative_matches: int
    tentative_inliers: int
    log10_nfa: float
    simulated_views: int
    scene: str = "none"
    on_plane: int = 0
    off_plane: int = 0
    verified: float = 0.0
    correlation: float = 0.0
    confidence: str = "none"

    def swapped(self) -> TwoViewGeometry:
        """Return the geometry from the second image to the first."""
        return replace(self, matrix=_swapped(self.model, self.matrix))


def _swapped(model: str, matrix: np.ndarray | None) -> np.ndarray | None:
    """Return the matrix of a model from the second image to the first."""
    if matrix is None or model != "homography":
        return None if matrix is None else matrix.T
    inverse = np.linalg.inv(matrix)
    return inverse / inverse[2, 2]


@dataclass(frozen=True, eq=False)
class GuidedMatches:
    """Matches of keypoints of the first image.

    Attributes:
        indices0: (M,) int64 keypoints of the first image, rising, each once.
        points1: (M, 2) float64 positions in the second image.
        scores: (M,) float32 in [0, 1], higher is better.
        subpixel: whether the positions are sub-pixel ones, of a rectified pair.
        indices1: (M,) int64 keypoints of the second image; None where the positions are others.
        points0: (M, 2) float64 positions in the first image where they are not those of keypoints:
            then the index of a match that no keypoint is near is -1.
        alike: (M,) bool, false where the images contradict: the window around the match, held out
            from the matches that predict where it is, is no more alike than unrelated ones.
    """

    indices0: np.ndarray
    points1: np.ndarray
    scores: np.ndarray
    subpixel: bool = False
    indices1: np.ndarray | None = None
    points0: np.ndarray | None = None
    alike: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.indices0)

    def starts(self, xy0: np.ndarray) -> np.ndarray:
        """Return the positions in the first image, (M, 2), of keypoints at `xy0`."""
        return xy0[self.indices0] if self.points0 is None else self.points0

    def joined(self, other: GuidedMatches, chosen: np.ndarray) -> GuidedMatches:
        """Return these matches and those of the (M,) bool `chosen` of others, of keypoints."""
        order = np.argsort(np.append(self.indices0, other.indices0[chosen]), kind="stable")

        def both(name: str) -> np.ndarray:
            return np.concatenate([getattr(self, name), getattr(other, name)[chosen]])[order]

        indices1 = None if self.indices1 is None or other.indices1 is None else both("indices1")
        columns = both("indices0"), both("points1"), both("scores")
        return GuidedMatches(*columns, self.subpixel, indices1)


class _Lazy:
    """A field of keypoints, or of a function that finds them when they are first asked for."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, instance: Any, owner: type | None = None) -> Keypoints:
        if instance is None:
            raise AttributeError(self.name)  # so that the field has no default
        keypoints = instance.__dict__[self.name]
        if not isinstance(keypoints, Keypoints):
            keypoints = instance.__dict__[self.name] = keypoints()
        return keypoints

    def __set__(self, instance: Any, value: Any) -> None:
        instance.__dict__[self.name] = value


def lazy(find: Callable[[], Keypoints]) -> Keypoints:
    """Return what `Matches` takes as keypoints, and finds when they are first asked for."""
    return cast(Keypoints, find)


@suggest_keywords
@dataclass(frozen=True, eq=False, repr=False)
class Matches:
    """Matched keypoints of two images.

    Attributes:
        points0, points1: (M, 2) float32 positions in the first and in the second
            image, matched row by row; centre of the first pixel (0, 0). Both are keypoints,
            except where a fundamental matrix guided: then those of the first image are the pixels
            of its keypoints, and those of the second where these pixels are seen; with `mutual`
            it may be the other way round.
        scores: (M,) float32 in [0, 1], higher is better. Guided by a homography, 1 - the
            dissimilarity of the two patches (0: only just more similar than unrelated patches); by
            a fundamental matrix, their correlation; else 1 - Lowe's ratio.
        inliers: (M,) bool, the matches whose error under the geometry is below
            `GeometryOptions.inlier_threshold`; all of them where none was asked for. Not those of
            guided matches that the images contradict: windows that others predict, around them,
            are no more alike than unrelated ones.
        model: which geometry that is: "homography", "fundamental", "essential" or "none".
        matrix: (3, 3) float64, the geometry; None when it could not be estimated, or was not
            asked for. A homography maps the first image to the second; else x1^T M x0 = 0
            (essential: in normalised coordinates).
        keypoints0, keypoints1: all keypoints of the two images. Of a pair without success they may
            be lazy: they are found when they are first asked for.
        seconds: time of each stage, both images together.
        two_view_geometry: the geometry that guided the matching; None without guided matching.
        subpixel: whether the matching itself found sub-pixel positions in the second image, by
            rectification: they need no refinement.
        indices0, indices1: (M,) int32 rows of `keypoints0` and `keypoints1`: the keypoints that are
            matched. Exactly they, unguided and where a homography guided. Where a fundamental
            matrix guided, the first is the keypoint on whose pixel the match lies, and the second
            the one nearest to it, up to a pixel away: -1 where there is none, and
            `m[m.indices1 >= 0]` are the others (with `mutual` it may be the other way round).
            None: the nearest ones are looked up.

    A detector finds the same keypoints in an image whatever it is matched with, so for the same
    options the same index is the same keypoint in all pairs of an image: tracks chain by them.

    `len` and indexing by slices, masks, index arrays and whole numbers work: `m[m.inliers]`.

    Raises:
        OptionError: the shapes do not fit together, or an index is of no keypoint.

    Example:
        >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
        >>> ends = points.xy, points.xy
        >>> m = Matches(*ends, [0.5, 0.2], [True, False], "none", None, points, points)
        >>> m
        Matches(2 matches of 2 and 2 keypoints, 1 inliers, model='none', confidence='none')
        >>> m[m.inliers].indices1.tolist()
        [0]
    """

    points0: np.ndarray
    points1: np.ndarray
    scores: np.ndarray
    inliers: np.ndarray
    model: str
    matrix: np.ndarray | None
    keypoints0: Keypoints = _Lazy()  # type: ignore[assignment]
    keypoints1: Keypoints = _Lazy()  # type: ignore[assignment]
    seconds: dict[str, float] = field(default_factory=dict)
    two_view_geometry: TwoViewGeometry | None = None
    subpixel: bool = False
    indices0: np.ndarray = None  # type: ignore[assignment]  # never None once it is made
    indices1: np.ndarray = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for name, dtype in _COLUMNS.items():
            columns = 2 if name.startswith("points") else None
            values = numbers_of(name, getattr(self, name), dtype, columns)
            object.__setattr__(self, name, values if columns else values.ravel())
        counts = [len(self.points0), len(self.points1), len(self.scores), len(self.inliers)]
        if len(set(counts)) > 1:
            raise OptionError(
                f"matches need as many points0, points1, scores and inliers, not {counts}"
            )
        if not (np.isfinite(self.points0).all() and np.isfinite(self.points1).all()):
            raise OptionError("matches need finite positions: leave out those that are not")
        for side in (0, 1):
            name = f"indices{side}"
            indices = getattr(self, name)
            if indices is None and len(self):
                keypoints = getattr(self, f"keypoints{side}")
                indices, distances = nearest_keypoints(
                    getattr(self, f"points{side}"), keypoints.xy, keypoints.image_size
                )
                indices[distances > MAX_KEYPOINT_DISTANCE_PX] = -1
            indices = numbers_of(name, () if indices is None else indices, None)
            object.__setattr__(self, name, self._checked_indices(indices, side))

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: keypoints, not a function that would find them."""
        return {**self.__dict__, "keypoints0": self.keypoints0, "keypoints1": self.keypoints1}

    @property
    def guided(self) -> bool:
        """Whether a geometry guided these matches."""
        return self.two_view_geometry is not None and self.two_view_geometry.model != "none"

    @property
    def success(self) -> bool:
        """False where a geometry was to guide these matches and none could be trusted."""
        return self.two_view_geometry is None or self.guided

    @property
    def confidence(self) -> str:
        """How far these matches can be trusted as a whole: "high", "fair" or "none".

        By their `two_view_geometry`; without one "none".
        """
        return "none" if self.two_view_geometry is None else self.two_view_geometry.confidence

    @property
    def homography(self) -> np.ndarray | None:
        """The (3, 3) homography of the first image to the second; None where it is another."""
        return self.matrix if self.model == "homography" else None

    @property
    def fundamental(self) -> np.ndarray | None:
        """The (3, 3) fundamental matrix, x1^T F x0 = 0; None where the geometry is another."""
        return self.matrix if self.model == "fundamental" else None

    def to_opencv(self) -> list[cv2.DMatch]:
        """Convert to OpenCV's matches of `keypoints0.to_opencv()` and `keypoints1.to_opencv()`.

        Their distances are 1 - score. Matches that end at no keypoint are left out.

        Example:
            >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
            >>> ends = points.xy, points.xy[::-1]
            >>> m = Matches(*ends, [0.5, 0.2], [True, True], "none", None, points, points)
            >>> [(match.queryIdx, match.trainIdx) for match in m.to_opencv()]
            [(0, 1), (1, 0)]
        """
        columns = self.indices0.tolist(), self.indices1.tolist(), (1 - self.scores).tolist()
        return [cv2.DMatch(i, j, d) for i, j, d in zip(*columns, strict=True) if min(i, j) >= 0]

    def unique(self) -> Matches:
        """Return one-to-one matches: those that score highest at both of their ends.

        Ends are one keypoint, or without one near one pixel. The first of equal scores counts.

        Example:
            >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
            >>> ends = points.xy[[0, 0, 1]], points.xy[[1, 0, 1]]
            >>> m = Matches(*ends, [0.5, 0.9, 0.3], [True] * 3, "none", None, points, points)
            >>> m.unique().points1.tolist()
            [[1.0, 2.0]]
        """
        kept = np.ones(len(self), bool)
        best_first = np.argsort(-self.scores, kind="stable")
        for side in (0, 1):
            ends = _ends(getattr(self, f"points{side}"), getattr(self, f"indices{side}"))
            best = np.unique(ends[best_first], return_index=True)[1]
            is_best = np.zeros(len(self), bool)
            is_best[best_first[best]] = True
            kept &= is_best
        return self[kept]

    def swapped(self) -> Matches:
        """Return the same matches from the second image to the first."""
        guide = self.two_view_geometry
        return replace(
            self,
            points0=self.points1,
            points1=self.points0,
            matrix=_swapped(self.model, self.matrix),
            keypoints0=self.keypoints1,
            keypoints1=self.keypoints0,
            two_view_geometry=None if guide is None else guide.swapped(),
            indices0=self.indices1,
            indices1=self.indices0,
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
        """Draw matches on both images side by side: lines, green for inliers and red for others.

        Args:
            image0, image1: arrays, PyTorch tensors or PIL images.
            channels: order of the colours in arrays and tensors.
            lines: at most this many are drawn: a random sample, the same each time.
            by_position: colour inliers by where they are in the first image, and draw more of them
                as dots than as lines, so that one sees what was matched where.

        Returns:
            (H, W, 3) uint8 RGB, its longer side at most 2,000 pixels.

        Raises:
            ImageError: an image has another size than its keypoints'.
        """
        from .display import checked_image, draw_matches

        rgb0 = checked_image(image0, self.keypoints0.image_size, channels)
        rgb1 = checked_image(image1, self.keypoints1.image_size, channels)
        ends = self.points0, self.points1, self.inliers
        return draw_matches(rgb0, rgb1, *ends, whole("lines", lines), by_position=by_position)

    def __len__(self) -> int:
        return len(self.points0)

    def __getitem__(self, index: slice | np.ndarray | Sequence[int] | int) -> Matches:
        rows = [int(index)] if isinstance(index, (int, np.integer)) else index
        names = (*_COLUMNS, "indices0", "indices1")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def _repr_html_(self) -> str:
        """Return what a notebook shows: a small table, and where some of the matches are."""
        from .display import html_summary

        inliers, geometry = np.count_nonzero(self.inliers), self.two_view_geometry
        guide = "nothing" if geometry is None else geometry.model
        rows = {
            "inliers": f"{inliers:,} ({self.model})",
            "guided by": guide if self.success else "no geometry that could be trusted",
        }
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
        if not self.success:  # whose keypoints may have to be found first
            return f"Matches({len(self)} matches, as no geometry could be trusted)"
        return (
            f"Matches({len(self)} matches of {len(self.keypoints0)} and {len(self.keypoints1)} "
            f"keypoints, {np.count_nonzero(self.inliers)} inliers, model={self.model!r}, "
            f"confidence={self.confidence!r})"
        )

    def _checked_indices(self, indices: np.ndarray, side: int) -> np.ndarray:
        """Return indices of an image's keypoints as int32, checked."""
        if indices.shape != (len(self),) or (indices.size and indices.dtype.kind not in "iu"):
            raise OptionError(
                f"matches need one whole number each as indices{side}, not {indices.dtype} "
                f"numbers of shape {indices.shape}"
            )
        if indices.size:
            count = len(self.keypoints1 if side else self.keypoints0)
            if not (indices.min() >= -1 and indices.max() < count):
                raise OptionError(
                    f"indices{side} must lie in [-1, {count - 1}], as there are {count} keypoints, "
                    f"not in [{indices.min()}, {indices.max()}]"
                )
        return indices.astype(np.int32)


def _ends(points: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Number the ends of matches: keypoints from 0 on, pixels without one below 0."""
    ends = indices.astype(np.int64)
    without = np.flatnonzero(indices < 0)
    if len(without):
        pixels = np.floor(points[without] + np.float32(0.5)).astype(np.int64)
        ends[without] = -1 - np.unique(pixels, axis=0, return_inverse=True)[1].reshape(-1)
    return ends
