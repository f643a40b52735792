"""Candidates: the local maxima of logits on a pyramid, as they are found at run time.

Which pixels they are is not differentiable; their logits and their sub-pixel positions are. No loss
rewards that a candidate stands out from its window: with that the network sharpened all peaks and
lost their order (the hard measure fell from .518 to .473 in 100 steps).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

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
    """

    xy: Tensor
    logits: Tensor


def find_candidates(levels: Sequence[Tensor], valid: np.ndarray, sharpness: float) -> Candidates:
    """Find the candidates of one view.

    Args:
        levels: (h, w) logits each, the first of the view's own size.
        valid: (H, W) bool; candidates elsewhere are left out.
        sharpness: as of `PointsTrainingOptions`.
    """
    height, width = valid.shape
    found = [_maxima(level, (width, height), valid) for level in levels]
    xy = torch.cat([part[0] for part in found])
    raw = torch.cat([part[1] for part in found])
    places, ranks = xy.detach().numpy(), raw.detach().numpy()
    kept = torch.from_numpy(suppress_neighbors(places, ranks, DISTANCE_PX).copy())
    spread = raw[kept].std() if len(kept) > 1 else raw.new_ones(())
    scale = sharpness / spread.clamp(min=MIN_SPREAD)
    logits = scale * (raw[kept] - raw[kept].mean()) if len(kept) else raw
    return Candidates(xy[kept], logits)


def _maxima(logits: Tensor, full: tuple[int, int], valid: np.ndarray) -> tuple[Tensor, Tensor]:
    """Return positions (N, 2) in the view, and logits (N,)."""
    height, width = logits.shape
    fixed = logits.detach()
    highest = max_pool2d(fixed[None, None], 2 * RADIUS + 1, 1, RADIUS)[0, 0]
    rows, columns = (t.numpy() for t in torch.nonzero(fixed == highest, as_tuple=True))
    scale = np.array([full[0] / width, full[1] / height])
    centers = (np.column_stack([columns, rows]) + 0.5) * scale - 0.5
    x, y = np.clip(np.rint(centers).astype(int), 0, np.subtract(full, 1)).T
    inner = (rows > 0) & (columns > 0) & (rows < height - 1) & (columns < width - 1)
    chosen = inner & valid[y, x]
    row, column = (torch.from_numpy(each[chosen]) for each in (rows, columns))
    flat = logits.reshape(-1)
    pixels = row * width + column

    def at(step: int) -> Tensor:
        return flat.index_select(0, pixels + step)  # its gradient is faster than indexing's

    center, shift = at(0), []
    for step in (1, width):
        before, after = at(-step), at(step)
        bend = (2 * center - before - after).clamp(min=MIN_BEND)
        shift.append(((after - before) / (2 * bend)).clamp(-MAX_OFFSET_PX, MAX_OFFSET_PX))
    xy = torch.stack([column, row], 1) + torch.stack(shift, 1)
    return (xy + 0.5) * torch.from_numpy(scale).float() - 0.5, center
