"""Judge geometries: images must agree with a geometry more than with displaced copies of it.

A geometry warps the second image into the frame of the first. Both are divided into cells, 4 px
apart. RootSIFT descriptors of both images at a cell correlate if they show the same place. A cell
is explained if its correlation, averaged over its neighbours, is above that of nearly all cells of
copies that are displaced by a quarter of the image or more.

On repeated patterns (windows, tiles, fences), a copy that is displaced by a period aligns cells as
well as the correct geometry does. So the copies that correlate best as a whole are compared with
the geometry, cell by cell. The geometry must explain clearly more cells than each of them. Content
that recurs one period away in the first image is no evidence for the geometry: where the pattern
ends, its next period may just be hidden.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..._shared.opencv import cv2
from ...features.matches import Evidence as PublicEvidence
from ...geometry.estimation import GeometryOptions, estimate_geometry
from ...geometry.transforms import (
    scaled_homography,
    scaled_points,
    translation_matrix,
)
from .cells import (
    CELL_PX,
    MARGIN_PX,
    SIDE_PX,
    WINDOW_CELLS,
    at_cells,
    describe,
    enlarged,
    gathered,
    mean_around,
    mean_gradient,
    predicted,
    shown_parts,
)
from .image_pair import ImagePair, Pair

DIMENSIONS = 64
"""Descriptors of both images are reduced from 256 numbers to the first 64 principal components of
those of the first image, so that correlations take a quarter of the time."""

FALSE_POSITIVE_RATE, CONTRADICTING_RATE = 0.01, 0.05
"""The correlation of a cell under a geometry is compared with those of all cells in copies of the
second image that are shifted by `FAR`. The geometry explains the cell if less than the fraction
FALSE_POSITIVE_RATE of these are as high. It contradicts the cell if, of the mean correlations
around cells, CONTRADICTING_RATE or more are as high as that around the cell. Set by hand."""

FAR = ((1 / 4, 0), (0, 1 / 4), (1 / 3, 1 / 3), (1 / 3, -1 / 3))
"""The second image shifted by plus or minus these fractions of its width and height gives the
correlations that occur by chance in this pair."""

MIN_PERIOD = 3
"""A pattern's period is searched from this many cells (4 px) on: nearer descriptors overlap."""

MIN_SIMILARITY, MAX_COPIES, MIN_OVERLAP = 0.4, 4, 0.5
"""A displaced copy of the warped image, which a pattern may fit, is tested if it correlates over
MIN_SIMILARITY times as well as the geometry, and MIN_OVERLAP of the overlap remains. The ratio is
up to 0.3 on planes of Oxford, 0.6 or more on facades of one repeated window. At most MAX_COPIES are
tested: a pattern is a lattice, whose points have four nearest neighbours."""

MIN_WON, MIN_WON_RATIO = 0.0125, 1.5
"""A geometry must explain at least the fraction MIN_WON of its cells clearly better than each
displaced copy, and MIN_WON_RATIO times as many as the copy explains better. The fraction is 0.03 or
more on facades with one odd window, 0.017 on a truss; on facades whose windows are all alike, some
copy leaves 0.012 or less."""

MIN_TIED = 0.5
"""A displaced copy of a geometry is a rival if it explains as well at least this fraction of what
the geometry explains. A copy that explains only the road of a street is no rival."""

MIN_STRUCTURE, MIN_GRADIENT = 0.5, 4.0
"""Limits of the mean difference of pixels two apart, in grey levels. Places below MIN_STRUCTURE in
both images are flat and not compared. Places above MIN_GRADIENT in both show more than noise:
noise of 5 grey levels, as of a phone at night, leaves 2 after the reduction and the blur."""

MIN_WINDOWS, MIN_SHARE = 8.0, 0.1
"""The images confirm a geometry if it explains at least MIN_WINDOWS windows of 16 x 16 px, and the
fraction MIN_SHARE of what is compared. Geometries of unrelated photographs explain up to 0.07 of
it. Correct ones of long strips of photographs, in other light, explain 8 windows or more."""

MIN_AGREEMENT, CLEAR_CORRELATION = 0.75, 0.5
"""Two images contradict a geometry if less than MIN_AGREEMENT of their structure agrees with it,
unless their median correlation is CLEAR_CORRELATION or more: in other light, as by night, the rest
may differ. If only the road fits (street views), agreement reaches 0.74 and correlation 0.48."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """How well a geometry explains the cells (descriptors, 4 px apart) of the first image.

    Attributes:
        similarity: (rows, columns) correlation of each cell with its place in the second image;
            NaN if unknown.
        bound: correlation above which a cell is explained.
        spread: standard deviation of the correlations of unrelated cells.
        contradicted: (rows, columns) bool, where a cell's surroundings correlate as by chance.
        structured: (rows, columns) bool, where both images show more than noise.
    """

    similarity: np.ndarray
    bound: float
    spread: float
    contradicted: np.ndarray
    structured: np.ndarray

    @cached_property
    def explained(self) -> np.ndarray:
        """(rows, columns) bool: cells that the geometry explains: they correlate above `bound`."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self.similarity > self.bound)

    @cached_property
    def believed(self) -> np.ndarray:
        """(rows, columns) bool, true in the cells whose matches are kept: the explained ones.

        Cells too near the border to be compared are true if explained ones are near; all are true
        if too little is compared to judge the geometry.
        """
        if not self.compares:
            return np.ones(self.similarity.shape, bool)
        side = 2 * (MARGIN_PX // CELL_PX + 1) + 1
        near = cv2.dilate(self.explained.astype(np.uint8), np.ones((side, side))) > 0
        return np.where(np.isfinite(self.similarity), self.explained, near)

    @property
    def compares(self) -> bool:
        """Whether enough cells are compared to trust the geometry or to doubt it."""
        compared = np.count_nonzero(np.isfinite(self.similarity))
        return bool(compared >= MIN_WINDOWS * WINDOW_CELLS)

    @property
    def windows(self) -> float:
        """Number of explained cells minus those expected by chance, in windows of 16 cells."""
        known = np.isfinite(self.similarity)
        by_chance = FALSE_POSITIVE_RATE * np.count_nonzero(known)
        return float((np.count_nonzero(self.explained) - by_chance) / WINDOW_CELLS)

    @property
    def agreement(self) -> float:
        """Fraction of cells showing more than noise whose surroundings correlate above chance."""
        compared = self.structured & np.isfinite(self.similarity)
        count = np.count_nonzero(compared)
        return float(np.count_nonzero(compared & ~self.contradicted) / count) if count else 0.0

    @property
    def correlation(self) -> float:
        """Median correlation of compared cells that show more than noise; 0 if there are none."""
        compared = self.similarity[self.structured & np.isfinite(self.similarity)]
        return float(np.median(compared)) if len(compared) else 0.0

    @property
    def confirms(self) -> bool:
        """Whether the number and the fraction of explained cells suffice to trust the geometry."""
        return self.windows >= MIN_WINDOWS and self.share >= MIN_SHARE

    @property
    def is_chance(self) -> bool:
        """Whether many cells are compared, and chance would explain half as many as explained."""
        compared = np.count_nonzero(np.isfinite(self.similarity)) / WINDOW_CELLS
        return bool(compared > MIN_WINDOWS / MIN_SHARE and self.share < 2 * FALSE_POSITIVE_RATE)

    @property
    def share(self) -> float:
        """Fraction of the compared cells that the geometry explains (see `explained`)."""
        known = np.count_nonzero(np.isfinite(self.similarity))
        return float(np.count_nonzero(self.explained) / known) if known else 0.0


def contradicts(evidence: Evidence | PublicEvidence) -> bool:
    """Return whether the images contradict a geometry (see `MIN_AGREEMENT`)."""
    clear = evidence.correlation >= CLEAR_CORRELATION
    return evidence.agreement < MIN_AGREEMENT and not clear


class Judge:
    """Judges geometries of two images by how well their descriptors correlate."""

    def __init__(self, pair: ImagePair) -> None:
        (self._first, scale0), (self._second, scale1) = (
            enlarged(*pair.reduced(side, SIDE_PX)) for side in (0, 1)
        )
        self._scales = scale0, scale1
        self._shown = [
            shown_parts(mask, gray.shape)
            for mask, gray in zip(pair.masks, (self._first, self._second), strict=True)
        ]

    @cached_property
    def _described(self) -> tuple[np.ndarray, np.ndarray]:
        """PCA axes of the first image's descriptors, and their coordinates, (rows, columns, D)."""
        cells, shape = describe(self._first)
        axes = np.linalg.eigh(cells.T @ cells)[1][:, -DIMENSIONS:]
        return axes, (cells @ axes).reshape(*shape, DIMENSIONS)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and columns of cells in the first image."""
        rows, columns = self._described[1].shape[:2]
        return rows, columns

    def cells_of(self, points0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows and columns of the cells of (N, 2) points of the first image."""
        last = np.array(self.shape[::-1]) - 1
        column, row = (
            (scaled_points(points0, self._scales[0]) / CELL_PX).astype(int).clip(0, last).T
        )
        return row, column

    def lattice(self) -> np.ndarray:
        """Return (N, 2) float32 positions on whole pixels of the first image, two cells apart."""
        rows, columns = self.shape
        x, y = (CELL_PX * (np.arange(0, count, 2) + 0.5) for count in (columns, rows))
        points = np.dstack(np.meshgrid(x, y)).reshape(-1, 2) / self._scales[0]
        return np.rint(points).astype(np.float32)

    def along_plane(self, homography: np.ndarray) -> View:
        """Return the second image, warped to the frame of the first by a homography."""
        matrix, size = scaled_homography(homography, *self._scales), self._first.shape[::-1]
        nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        valid = cv2.warpPerspective(self._shown[1], matrix, size, flags=nearest) > 0
        how = {"flags": cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
        return self._view(cv2.warpPerspective(self._second, matrix, size, **how), valid)

    def along_matches(self, points0: np.ndarray, points1: np.ndarray) -> View:
        """Return the second image, warped to the frame of the first by matches.

        Each window is placed by the matches *around* it, not by those inside it, so it shows the
        content of the first image only if the matches are correct.
        """
        points0, points1 = (
            scaled_points(points, scale)
            for points, scale in zip((points0, points1), self._scales, strict=True)
        )
        ends, known = predicted(points0, points1, self._first.shape)
        height, width = self._second.shape
        x, y = np.moveaxis(ends, 2, 0)
        known &= (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        known &= cv2.remap(self._shown[1], x, y, cv2.INTER_NEAREST) > 0
        warped = cv2.remap(self._second, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        return self._view(warped, known)

    def _view(self, warped: np.ndarray, valid: np.ndarray) -> View:
        gradients = [mean_gradient(gray) for gray in (self._first, warped)]
        valid &= (self._shown[0] > 0) & (np.maximum(*gradients) > MIN_STRUCTURE)
        axes, cells = self._described
        return View((self._first, warped), axes, cells, valid, self._shown[0])


class View:
    """The second image, warped to the frame of the first and compared with the first by cells."""

    def __init__(
        self,
        images: Pair,
        axes: np.ndarray,
        first: np.ndarray,
        valid: np.ndarray,
        shown: np.ndarray,
    ) -> None:
        self._images, self._axes, self._first = images, axes, first
        self._pixels, self._shown, self._valid = valid.astype(np.uint8), shown, at_cells(valid)
        self._second = self._projected(images[1])

    @cached_property
    def evidence(self) -> Evidence:
        """The correlation of each cell, and the limits that displaced copies (`FAR`) set."""
        rows, columns = self._valid.shape
        far = [
            self._displaced(round(sign * x * columns), round(sign * y * rows))
            for x, y in FAR
            for sign in (1, -1)
        ]
        chance = np.concatenate([each[np.isfinite(each)] for each in far])
        if len(chance) < WINDOW_CELLS:
            nowhere = np.zeros(self._valid.shape, bool)
            return Evidence(np.full(self._valid.shape, np.nan), 1.0, 1.0, nowhere, nowhere)
        # The median discards copies that happen to be displaced by the period of a pattern.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # from copies that overlap no cell
            bounds = [np.nanquantile(each, 1 - FALSE_POSITIVE_RATE) for each in far]
        bound = float(np.nanmedian(bounds))
        own = self._displaced(0, 0)
        around = [mean_around(each) for each in (own, *far)]
        with np.errstate(invalid="ignore"):
            most = np.nanquantile(np.stack(around[1:]), 1 - CONTRADICTING_RATE)
            contradicted = np.asarray(around[0] <= most)
        gradients = [at_cells(mean_gradient(gray)) for gray in self._images]
        structured = np.minimum(*gradients) > MIN_GRADIENT
        return Evidence(own, bound, float(chance.std()), contradicted, structured)

    @cached_property
    def repeated(self) -> bool:
        """Whether a displaced copy explains the image as well as the geometry does."""
        own = self.evidence.similarity
        bound, spread = self.evidence.bound, self.evidence.spread
        everywhere = self._shown
        for shift in self._similar_shifts():
            move, field = self._refined(shift)
            if np.abs(np.median(field, axis=(0, 1))).max() < MIN_PERIOD:
                continue  # after its refinement, the copy is the geometry itself
            near = gathered(self._first, self._second, self._valid, field)
            with np.errstate(invalid="ignore"):
                tied = self.evidence.explained & (own - near < 2 * spread)
            if np.count_nonzero(tied) < MIN_TIED / 2 * np.count_nonzero(self.evidence.explained):
                continue
            copy = self._moved(self._images[1], self._pixels, move)
            recurring = np.fmax(
                *(
                    self._moved(self._images[0], everywhere, each)
                    for each in (move, np.linalg.inv(move))
                )
            )
            with np.errstate(invalid="ignore"):
                known = np.isfinite(own) & np.isfinite(copy)
                explained = known & (own > bound)
                won = explained & (own - copy > spread) & ~(recurring > bound)
                better = np.count_nonzero(known & (copy > bound) & (copy - own > spread))
                tied = np.count_nonzero(explained & ~(own - copy > spread))
            lost = better - FALSE_POSITIVE_RATE * np.count_nonzero(known & ~explained)
            total = np.count_nonzero(explained)
            if tied < MIN_TIED * total:
                continue
            if np.count_nonzero(won) < max(MIN_WON * total, MIN_WON_RATIO * lost):
                return True
        return False

    def _moved(self, image: np.ndarray, valid: np.ndarray, move: np.ndarray) -> np.ndarray:
        """Correlate the first image with an image moved by a homography in cell coordinates."""
        to_cells = np.array([[1 / CELL_PX, 0, 0], [0, 1 / CELL_PX, 0], [0, 0, 1]])
        to_cells[:2, 2] = -(CELL_PX // 2) / CELL_PX
        matrix, size = np.linalg.inv(to_cells) @ move @ to_cells, image.shape[::-1]
        how = {"flags": cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
        nearest = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        known = cv2.warpPerspective(valid, matrix, size, flags=nearest) > 0
        cells = self._projected(cv2.warpPerspective(image, matrix, size, **how))
        return gathered(self._first, cells, at_cells(known), np.zeros((*cells.shape[:2], 2)))

    def _projected(self, image: np.ndarray) -> np.ndarray:
        cells, shape = describe(image)
        return (cells @ self._axes).reshape(*shape, DIMENSIONS)

    def _displaced(self, x: int, y: int) -> np.ndarray:
        field = np.broadcast_to(np.array([x, y], np.float64), (*self._valid.shape, 2))
        return gathered(self._first, self._second, self._valid, field)

    def _similar_shifts(self) -> np.ndarray:
        """Return displacements (x, y), in cells, at which the images correlate nearly as well."""
        rows, columns = self._valid.shape
        size = cv2.getOptimalDFTSize(2 * rows), cv2.getOptimalDFTSize(2 * columns)
        valid = self._valid.astype(np.float64)
        some = slice(-24, None)  # the 24 main components of descriptors suffice to find periods
        first, second = (
            np.fft.rfft2(cells[..., some], size, axes=(0, 1))
            for cells in (self._first, self._second * self._valid[..., None])
        )
        total = np.fft.irfft2((np.conj(first) * second).sum(axis=2), size)
        whole, part = np.fft.rfft2(np.ones_like(valid), size), np.fft.rfft2(valid, size)
        overlap = np.fft.irfft2(np.conj(whole) * part, size)
        enough = overlap >= MIN_OVERLAP * valid.sum()
        values = np.where(enough, total / np.maximum(overlap, 1), -1.0)
        side = 2 * MIN_PERIOD + 1
        peaks = (cv2.dilate(values, np.ones((side, side))) == values) & enough
        peaks &= values > MIN_SIMILARITY * values[0, 0]
        shifts = np.argwhere(peaks)[np.argsort(-values[peaks], kind="stable")]
        shifts = np.where(shifts > np.array(size) / 2, shifts - size, shifts)[:, ::-1]
        return shifts[np.abs(shifts).max(axis=1) >= MIN_PERIOD][:MAX_COPIES]

    def _refined(self, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the homography of a displaced copy near a shift, and each cell's displacement.

        As periods differ over a tilted view, the homography is fitted to each cell's best shift.
        """
        rows, columns = self._valid.shape
        y, x = np.indices((rows, columns))
        here = np.dstack([x, y]).astype(np.float64)
        field = np.broadcast_to(shift.astype(np.float64), here.shape)
        result = translation_matrix(*shift)
        every = np.s_[::2, ::2]
        cells, places = self._first[every], here[every]
        for reach, step in ((4, 2), (2, 1)):
            steps = np.arange(-reach, reach + 1, step, dtype=float)
            around, moves = np.dstack(np.meshgrid(steps, steps)).reshape(-1, 2), field[every]
            near = np.stack(
                [
                    gathered(cells, self._second, self._valid, moves + each, places)
                    for each in around
                ]
            )
            near = np.where(np.isfinite(near), near, -1)
            good = near.max(axis=0) > self.evidence.bound
            if np.count_nonzero(good) < 2 * WINDOW_CELLS:
                return result, field
            starts = places[good]
            ends = starts + moves[good] + around[near.argmax(axis=0)[good]]
            options = GeometryOptions(inlier_threshold=1.5)
            matrix = estimate_geometry(starts, ends, "homography", options=options).matrix
            if matrix is None:
                return result, field
            mapped = cv2.perspectiveTransform(here.reshape(1, -1, 2), matrix).reshape(here.shape)
            if not np.abs(np.median(mapped - here - field, axis=(0, 1))).max() <= reach:
                return result, field
            field, result = mapped - here, matrix
        return result, field
