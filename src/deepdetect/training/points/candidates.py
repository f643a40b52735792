"""Candidates: the local maxima of logits on a pyramid, as they are found at run time.

Which pixels they are is not differentiable; their logits, their sub-pixel positions and their
shares of the places around them are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from ...features.suppression import suppress_neighbors

RADIUS = 2
"""A candidate is the maximum of a window of 5x5 in its level."""

DISTANCE_PX = 2.0
MAX_OFFSET_PX = 0.499
MIN_BEND = 1e-6
MIN_SPREAD = 1e-3


@dataclass(frozen=True)
class Candidates:
    """The candidates of one view that no better one of another level is near.

    Attributes:
        xy: (N, 2) sub-pixel positions in the view, differentiable.
        logits: (N,) of mean 0 and standard deviation `sharpness`.
        shares: (N,) of the softmax over the window and over the neighbours of other levels.
        scale: what raw logits were multiplied with.
    """

    xy: Tensor
    logits: Tensor
    shares: Tensor
    scale: Tensor


def find_candidates(levels: Sequence[Tensor], valid: np.ndarray, sharpness: float) -> Candidates:
    """Find the candidates of one view.

    Args:
        levels: (h, w) logits each, the first of the view's own size.
        valid: (H, W) bool; candidates elsewhere are left out.
        sharpness: as of `PointsTrainingOptions`.
    """
    height, width = valid.shape
    found = [_maxima(level, (width, height), valid) for level in levels]
    xy, windows = (torch.cat([part[k] for part in found]) for k in range(2))
    raw = windows[:, windows.shape[1] // 2]
    places, ranks = xy.detach().numpy(), raw.detach().numpy()
    kept = torch.from_numpy(suppress_neighbors(places, ranks, DISTANCE_PX).copy())
    spread = raw[kept].std() if len(kept) > 1 else raw.new_ones(())
    scale = sharpness / spread.clamp(min=MIN_SPREAD)
    # The centre is the largest of its window.
    around = (scale * (windows[kept] - raw[kept, None])).exp().sum(1)
    rows, others = _neighbors(places, kept.numpy())
    rivals = torch.zeros_like(around).index_add(
        0, rows, (scale * (raw[others] - raw[kept[rows]])).clamp(max=0).exp()
    )
    logits = scale * (raw[kept] - raw[kept].mean()) if len(kept) else raw
    return Candidates(xy[kept], logits, 1 / (around + rivals), scale)


def _maxima(logits: Tensor, full: tuple[int, int], valid: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return positions (N, 2) in the view, and the logits around them, (N, 25)."""
    height, width = logits.shape
    fixed = logits.detach()
    window = 2 * RADIUS + 1
    highest = max_pool2d(fixed[None, None], window, 1, RADIUS)[0, 0]
    rows, columns = (t.numpy() for t in torch.nonzero(fixed == highest, as_tuple=True))
    scale = np.array([full[0] / width, full[1] / height])
    centers = (np.column_stack([columns, rows]) + 0.5) * scale - 0.5
    x, y = np.clip(np.rint(centers).astype(int), 0, np.subtract(full, 1)).T
    inner = (rows > 0) & (columns > 0) & (rows < height - 1) & (columns < width - 1)
    chosen = inner & valid[y, x]
    row, column = (torch.from_numpy(each[chosen]) for each in (rows, columns))
    padded = pad(logits[None, None], (RADIUS,) * 4, mode="replicate")[0, 0].reshape(-1)
    steps = torch.arange(window)
    offsets = (steps[:, None] * (width + 2 * RADIUS) + steps).reshape(-1)
    places = (row * (width + 2 * RADIUS) + column)[:, None] + offsets
    # Its gradient is much faster than that of indexing.
    windows = padded.index_select(0, places.reshape(-1)).view(places.shape)
    middle = windows.shape[1] // 2
    center = windows[:, middle]
    shift = []
    for step in (1, window):
        before, after = windows[:, middle - step], windows[:, middle + step]
        bend = (2 * center - before - after).clamp(min=MIN_BEND)
        shift.append(((after - before) / (2 * bend)).clamp(-MAX_OFFSET_PX, MAX_OFFSET_PX))
    xy = torch.stack([column, row], 1) + torch.stack(shift, 1)
    return (xy + 0.5) * torch.from_numpy(scale).float() - 0.5, windows


def _neighbors(places: np.ndarray, kept: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return pairs of a row of the kept ones and a suppressed candidate near it."""
    from scipy.spatial import KDTree

    if not len(kept):
        return torch.zeros(0, dtype=torch.long), torch.zeros(0, dtype=torch.long)
    near = KDTree(places[kept]).sparse_distance_matrix(
        KDTree(places), DISTANCE_PX, output_type="coo_matrix"
    )
    other = near.col != kept[near.row]
    return (
        torch.from_numpy(near.row[other].astype(np.int64)),
        torch.from_numpy(near.col[other].astype(np.int64)),
    )
