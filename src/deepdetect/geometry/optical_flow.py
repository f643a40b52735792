"""Corners tracked from one image to another and back (Lucas-Kanade)."""

from __future__ import annotations

import numpy as np

from .._shared.opencv import cv2


def track_round_trip(
    first: np.ndarray,
    second: np.ndarray,
    points: np.ndarray,
    window_px: int,
    *,
    levels: int,
    iterations: int = 30,
    step_px: float = 0.01,
    min_eigenvalue: float = 1e-4,
    expected: np.ndarray | None = None,
    back_to_start: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Track points forth and back.

    Args:
        first, second: (H, W) uint8 images.
        points: (N, 2) float32 positions in the first.
        window_px: side of the tracked windows.
        levels: of the pyramid above the image; each doubles how far a track can move.
        iterations: of each track and level, at most.
        step_px: a track that moves by less than this has arrived.
        min_eigenvalue: of the gradients in a window, per pixel, below which a track is lost.
        expected: (N, 2) float32 positions in the second, where the search begins; None: in the
            same place.
        back_to_start: whether the way back begins at the start itself.

    Returns:
        (N, 2) float32 positions in the second, and (N,) distances from the start after the way
        back, infinite where a track was lost.
    """
    how = {
        "winSize": (window_px, window_px),
        "maxLevel": levels,
        "criteria": (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, step_px),
        "minEigThreshold": min_eigenvalue,
    }
    guided = {**how, "flags": cv2.OPTFLOW_USE_INITIAL_FLOW}
    start = np.ascontiguousarray(points, np.float32).reshape(-1, 1, 2)
    if expected is not None:
        guess = np.ascontiguousarray(expected, np.float32).reshape(-1, 1, 2)
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, guess.copy(), **guided)
        back_guess = there + start - guess
    else:
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, second, start, None, **how)
        back_guess = start.copy() if back_to_start else None
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(
        second, first, there, back_guess, **(how if back_guess is None else guided)
    )
    gaps = np.linalg.norm((back - start).reshape(-1, 2), axis=1)
    lost = (found.ravel() == 0) | (found_back.ravel() == 0)
    return there.reshape(-1, 2), np.where(lost, np.inf, gaps)


def equalise(gray: np.ndarray) -> np.ndarray:
    """Equalise an image locally, so that changes of light are not taken for motion."""
    return cv2.createCLAHE(clipLimit=3.0, tileGridSize=(8, 8)).apply(gray)
