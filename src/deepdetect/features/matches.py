"""Matched keypoints of two images, and the geometry between them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from .._shared.errors import OptionError
from .._shared.options import suggest_keywords
from .keypoints import Keypoints


@suggest_keywords
@dataclass(frozen=True, eq=False)
class Guide:
    """The geometry that guided the matching of two images.

    Attributes:
        model: "homography", "fundamental", or "none": no geometry could be trusted, and there are
            no matches.
        matrix: (3, 3) float64, refined, of the first image to the second; None without one.
        sparse_matches: number of sparse matches that it was first estimated from.
        sparse_inliers: number of those that agree with it.
        log10_nfa: decimal logarithm of its number of false alarms (a contrario).
        simulated_views: number of views that were simulated to find it, as in ASIFT.
    """

    model: str
    matrix: np.ndarray | None
    sparse_matches: int
    sparse_inliers: int
    log10_nfa: float
    simulated_views: int

    def swapped(self) -> Guide:
        """Return the geometry from the second image to the first."""
        if self.matrix is None:
            return self
        if self.model != "homography":
            return replace(self, matrix=self.matrix.T)
        inverse = np.linalg.inv(self.matrix)
        return replace(self, matrix=inverse / inverse[2, 2])


@dataclass(frozen=True, eq=False)
class GuidedMatches:
    """Matches of keypoints of the first image.

    Attributes:
        rows0: (M,) int64 keypoints of the first image, rising, each once.
        points1: (M, 2) float64 positions in the second image: keypoints of it where a homography
            guided, sub-pixel positions where the pair was rectified.
        scores: (M,) float32 in [0, 1], higher is better.
        subpixel: whether the positions in the second image are sub-pixel.
        rows1: (M,) int64 keypoints of the second image; None where the positions are others.
    """

    rows0: np.ndarray
    points1: np.ndarray
    scores: np.ndarray
    subpixel: bool = False
    rows1: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.rows0)

    def unique(self) -> GuidedMatches:
        """Keep the best match of those that end on the same pixel of the second image."""
        pixels = np.rint(self.points1).astype(np.int64)
        best_first = np.lexsort((self.rows0, -self.scores))
        _, first = np.unique(pixels[best_first], axis=0, return_index=True)
        kept = np.sort(best_first[first])
        return replace(
            self,
            rows0=self.rows0[kept],
            points1=self.points1[kept],
            scores=self.scores[kept],
            rows1=None if self.rows1 is None else self.rows1[kept],
        )


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
            `GeometryOptions.inlier_threshold`; all of them where none was asked for.
        model: which geometry that is: "homography", "fundamental", "essential" or "none".
        matrix: (3, 3) float64, the geometry; None when it could not be estimated, or was not
            asked for. A homography maps the first image to the second; else x1^T M x0 = 0
            (essential: in normalised coordinates).
        keypoints0, keypoints1: all keypoints of the two images.
        seconds: time of each stage, both images together.
        guide: the geometry that guided the matching; None when guided matching was not asked for.
        subpixel: whether the matching itself found sub-pixel positions in the second image, by
            rectification: they need no refinement.

    Example:
        >>> points = Keypoints([[1, 2], [3, 4]], [0.9, 0.6], (8, 8))
        >>> Matches(points.xy, points.xy, [0.5, 0.2], [True, False], "none", None, points, points)
        Matches(2 matches of 2 and 2 keypoints, 1 inliers, model='none', guided=False)
    """

    points0: np.ndarray
    points1: np.ndarray
    scores: np.ndarray
    inliers: np.ndarray
    model: str
    matrix: np.ndarray | None
    keypoints0: Keypoints
    keypoints1: Keypoints
    seconds: dict[str, float] = field(default_factory=dict)
    guide: Guide | None = None
    subpixel: bool = False

    def __post_init__(self) -> None:
        counts = [len(self.points0), len(self.points1), len(self.scores), len(self.inliers)]
        if len(set(counts)) > 1:
            raise OptionError(
                "matches need as many points0, points1, scores and inliers, not "
                f"{', '.join(map(str, counts))}"
            )

    @property
    def guided(self) -> bool:
        """Whether a geometry guided these matches."""
        return self.guide is not None and self.guide.model != "none"

    @property
    def lost(self) -> bool:
        """Whether a geometry was to guide these matches and none could be trusted."""
        return self.guide is not None and self.guide.model == "none"

    def __len__(self) -> int:
        return len(self.points0)

    def __repr__(self) -> str:
        return (
            f"Matches({len(self)} matches of {len(self.keypoints0)} and {len(self.keypoints1)} "
            f"keypoints, {np.count_nonzero(self.inliers)} inliers, model={self.model!r}, "
            f"guided={self.guided})"
        )
