"""Where in the image keypoints lie: coverage of a grid, and fraction on the foreground."""

from __future__ import annotations

import numpy as np

CELL_PX = 32


def coverage(xy: np.ndarray, size: tuple[int, int], cell_px: int = CELL_PX) -> float:
    """Return the fraction of a grid's cells that hold a keypoint.

    Args:
        xy: (N, 2) positions, centre of the first pixel (0, 0).
        size: (width, height) of the image.
        cell_px: side of the square cells; those at the right and lower border may be smaller.

    Example:
        >>> coverage(np.array([[0, 0], [31, 31], [32, 0]]), (64, 64))
        0.5
    """
    columns, rows = -(-size[0] // cell_px), -(-size[1] // cell_px)
    position = np.floor((np.asarray(xy, np.float64).reshape(-1, 2) + 0.5) / cell_px).astype(int)
    position = np.clip(position, 0, (columns - 1, rows - 1))
    return len(np.unique(position[:, 1] * columns + position[:, 0])) / (columns * rows)


def foreground_fraction(xy: np.ndarray, foreground: np.ndarray) -> float:
    """Return the fraction of the keypoints that lie on the foreground (paper, Section IV-A).

    Args:
        xy: (N, 2) positions.
        foreground: (H, W) bool.

    Returns:
        In [0, 1]; NaN without keypoints.

    Example:
        >>> foreground_fraction(np.array([[0, 0], [1, 0]]), np.array([[True, False]]))
        0.5
    """
    if not len(xy):
        return float("nan")
    height, width = foreground.shape
    column, row = np.rint(np.asarray(xy)).astype(int).T
    inside = foreground[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return float(inside.mean())
