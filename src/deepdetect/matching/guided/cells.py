"""Divide two images into cells, one descriptor every 4 pixels, by which geometries are compared."""

from __future__ import annotations

import numpy as np

from ..._shared.opencv import cv2
from ...features.sift import dense_sift, sift_gradient, to_root_sift
from ...geometry.transforms import scaling_matrix

SIDE_PX = 480
"""Images are scaled to this longer side before they are compared, so that a descriptor covers the
same part of any image. A homography that is off by 3 of 640 pixels still aligns the descriptors."""

CELL_PX, SIZES_PX = 4, (2.5, 4.5)
"""Images are described at cells, CELL_PX pixels apart, by RootSIFT at two keypoint diameters,
SIZES_PX. A descriptor covers six diameters. With 3 and 6 px, outlines of small planes are blurred;
with less than SIZES_PX, fewer descriptors match in darkness and fog."""

WINDOW_CELLS = 16
"""Number of cells, 4 px apart, in a window of 16 x 16 pixels. Areas that a geometry explains are
counted in windows, because the descriptors of adjacent cells share most of their pixels."""

MIN_WINDOWS_AROUND = 5
"""Matches predict where a 16 x 16 px window lies if this many of its 8 neighbours hold some."""

MARGIN_PX = 9
"""Descriptors closer than this to the border of an image or of an ignored area are not compared:
they mostly show the border, and two borders at the same place are no evidence."""


def enlarged(gray: np.ndarray, scale: float) -> tuple[np.ndarray, float]:
    """Enlarge an image whose longer side is below `SIDE_PX`; return it and its new scale."""
    factor = SIDE_PX / max(gray.shape)
    if factor <= 1:
        return gray, scale
    size = round(gray.shape[1] * factor), round(gray.shape[0] * factor)
    matrix, how = scaling_matrix(factor)[:2], {"flags": cv2.INTER_CUBIC}
    enlarged = cv2.warpAffine(gray, matrix, size, borderMode=cv2.BORDER_REPLICATE, **how)
    return enlarged, scale * factor


def shown_parts(mask: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return (H, W) uint8: 1 where all pixels within `MARGIN_PX` exist and are not masked."""
    if mask is None:
        mask = np.zeros(shape, bool)
    left = cv2.resize(mask.astype(np.uint8), shape[::-1], interpolation=cv2.INTER_NEAREST)
    side = 2 * MARGIN_PX + 1
    return cv2.erode(1 - left, np.ones((side, side)), borderValue=0)


def at_cells(mask: np.ndarray) -> np.ndarray:
    """Sample an (H, W) mask every `CELL_PX` pixels, where descriptors lie: (rows, columns)."""
    return mask[CELL_PX // 2 :: CELL_PX, CELL_PX // 2 :: CELL_PX]


def describe(gray: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """Return (N, D) float32 unit descriptors of cells, 0 in flat ones, and (rows, columns)."""
    height, width = gray.shape
    x, y = (np.arange(CELL_PX // 2, side, CELL_PX) for side in (width, height))
    pixels = np.dstack(np.meshgrid(x, y)).reshape(-1, 2)
    gradient, parts = sift_gradient(gray), []
    for size in SIZES_PX:
        described = to_root_sift(dense_sift(gray, pixels, size, CELL_PX, gradient))
        part = described.astype(np.float32)
        some = part.any(axis=1)
        part -= part[some].mean(axis=0) if some.any() else 0
        part /= np.maximum(np.linalg.norm(part, axis=1, keepdims=True), 1e-6)
        part[~some] = 0
        parts.append(part / np.float32(np.sqrt(len(SIZES_PX))))
    return np.hstack(parts), (len(y), len(x))


def gathered(
    first: np.ndarray,
    second: np.ndarray,
    valid: np.ndarray,
    field: np.ndarray,
    here: np.ndarray | None = None,
) -> np.ndarray:
    """Correlate cells of the first image with displaced ones of the second, averaged over 3 x 3.

    `field` holds the displacement (x, y) in cells of each cell of `first`, whose positions are
    `here`. Returns float32, NaN where the displaced cell is not `valid`.
    """
    if here is None:
        y, x = np.indices(field.shape[:2])
        here = np.dstack([x, y])
    rows, columns = valid.shape
    x, y = np.moveaxis(np.rint(np.where(np.isfinite(field), here + field, -1)).astype(int), 2, 0)
    known = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
    x, y = x.clip(0, columns - 1), y.clip(0, rows - 1)
    known &= valid[y, x]
    values = np.einsum("ijk,ijk->ij", first, second[y, x]) * known
    total, count = (
        cv2.boxFilter(each, cv2.CV_32F, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        for each in (values, known.astype(np.float32))
    )
    return np.where(known & (count >= 5), total / np.maximum(count, 1), np.float32(np.nan))


def mean_gradient(gray: np.ndarray) -> np.ndarray:
    """Return the mean gradient (difference of pixels two apart) in 24 x 24 px around each pixel."""
    side = 3 * round(WINDOW_CELLS**0.5) * CELL_PX // 2
    return cv2.boxFilter(sift_gradient(gray)[0], -1, (side, side))


def mean_around(values: np.ndarray) -> np.ndarray:
    """Average values of cells over the 12 x 12 cells around each cell; NaN stays NaN."""
    side = 3 * round(WINDOW_CELLS**0.5)
    known = np.isfinite(values)
    total, count = (
        cv2.boxFilter(each, cv2.CV_64F, (side, side), borderType=cv2.BORDER_CONSTANT)
        for each in (np.where(known, values, 0), known.astype(np.float32))
    )
    return np.where(known, total / np.maximum(count, 1e-9), np.nan)


def predicted(
    points0: np.ndarray, points1: np.ndarray, shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels' positions in the second image, (H, W, 2) float32, and which are known.

    Each 16 x 16 px window is mapped by an affinity fitted to matches in the 8 windows around it.
    """
    side = CELL_PX * round(WINDOW_CELLS**0.5)
    rows, columns = (-(-length // side) for length in shape)
    last = np.array([columns, rows]) - 1
    column, row = ((points0 + 0.5) // side).astype(np.int64).clip(0, last).T
    windows, size = row * columns + column, rows * columns

    def around(own: np.ndarray) -> np.ndarray:
        own = own.reshape(rows, columns).astype(np.float64)
        box = cv2.boxFilter(own, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(box - own)

    left = np.column_stack([points0, np.ones(len(points0))])
    squares, products = (
        np.array([[around(np.bincount(windows, a * b, size)) for b in right.T] for a in left.T])
        for right in (left, points1)
    )
    known = around(np.bincount(windows, minlength=size) > 0) >= MIN_WINDOWS_AROUND
    affine = np.zeros((rows, columns, 3, 2))
    affine[known] = np.linalg.solve(
        np.moveaxis(squares[..., known], -1, 0), np.moveaxis(products[..., known], -1, 0)
    )
    terms = affine.repeat(side, 0).repeat(side, 1)[: shape[0], : shape[1]]
    y, x = np.indices(shape)
    ends = terms[..., 0, :] * x[..., None] + terms[..., 1, :] * y[..., None] + terms[..., 2, :]
    whole = known.repeat(side, 0).repeat(side, 1)[: shape[0], : shape[1]]
    return ends.astype(np.float32), whole
