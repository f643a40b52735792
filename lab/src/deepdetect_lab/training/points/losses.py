"""The loss of a pair of views: less the expected fraction of keypoints that are found again.

Candidates and their positions are fixed; only their order is learned. The logits have a fixed
standard deviation, so the loss does not fall when the ranker only makes its logits sharper.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from deepdetect.detector.points.detection import least_distances
from deepdetect.features.selection import suppress_neighbors

from .pairs import CandidatePair, ViewCandidates

CLOSE_PX, NEAR_PX = 1.0, 3.0

SHARPNESS = 25.0
"""Standard deviation of the logits over the keypoints of a view, to which they are scaled before
the loss: it cannot be lowered by sharper logits."""

TEMPERATURE = 0.6
"""Temperature of the soft choice of keypoints, in units of the logits. Chosen by hand."""

CLOSE_SHARE = 0.7
"""This share of a keypoint's reward requires its repetition within 1 px, the rest within 3 px."""

MIN_CHOICE = 0.1
"""Candidates with a smaller probability of being chosen get no partners. Chosen by hand."""

MIN_SPREAD = 1e-3
BISECTIONS = 40


def pair_loss(ranker: torch.nn.Module, pair: CandidatePair) -> Tensor:
    """Return the loss of a pair of views, seen in both directions.

    Its value is what is expected to be found again; its gradient is that at a fixed budget: a
    candidate that becomes more likely drives out others at the border of the budget, so its reward
    counts less theirs.
    """
    shares = [_choose(ranker, view, pair.budget) for view in pair.views]
    visible = [torch.from_numpy(view.visible) for view in pair.views]
    mass = min(float(shares[k].detach()[visible[k]].sum()) for k in range(2))
    total = shares[0].sum() * 0
    for k, view in enumerate(pair.views):
        share = shares[k].detach()
        reward = _rewards(view, share, shares[1 - k].detach())
        border = share * (1 - share) * visible[k]
        level = (reward * border).sum() / border.sum().clamp(min=1e-6)
        value = (share * reward * visible[k]).sum() / max(mass, 1.0)
        gain = (shares[k] * (reward - level) * visible[k]).sum() / max(mass, 1.0)
        total = total - value - (gain - gain.detach())
    return total / 2


def _choose(ranker: torch.nn.Module, view: ViewCandidates, budget: float) -> Tensor:
    """Return (N,) how surely each candidate is among the best; 0 where a better one is near."""
    logits = ranker(torch.from_numpy(view.features))
    radii = least_distances(view.sigma_px)  # as at run time
    kept = torch.from_numpy(suppress_neighbors(view.xy, logits.detach().numpy(), radii))
    fixed = logits[kept].detach()
    spread = fixed.std() if len(fixed) > 1 else fixed.new_ones(())
    scaled = (logits[kept] - fixed.mean()) * (SHARPNESS / spread.clamp(min=MIN_SPREAD))
    return torch.zeros(len(logits)).index_put((kept,), soft_top_k(scaled, budget, TEMPERATURE))


def soft_top_k(logits: Tensor, budget: float, temperature: float) -> Tensor:
    """Return sigmoid((logits - tau) / temperature), tau so that they sum to the budget."""
    fixed = logits.detach().double()
    if len(fixed) <= budget:
        return torch.sigmoid((logits - logits.detach().min()) / temperature + 4)
    low, high = fixed.min() - 20 * temperature, fixed.max() + 20 * temperature
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        if torch.sigmoid((fixed - middle) / temperature).sum() > budget:
            low = middle
        else:
            high = middle
    return torch.sigmoid((logits - low.float()) / temperature)


def _rewards(view: ViewCandidates, here: Tensor, there: Tensor) -> Tensor:
    """Return what a candidate is worth: its partner's choice, by the distances of the measure.

    One to one, as it is measured, and among those that may be chosen: with a sum over all near
    candidates, crowds of points are rewarded, and fewer points are found again within 1 px.
    """
    pairs = mutual_pairs(view, NEAR_PX, here.numpy() > MIN_CHOICE, there.numpy() > MIN_CHOICE)
    close = view.distance_px[pairs] <= CLOSE_PX
    worth = 1 - CLOSE_SHARE + CLOSE_SHARE * close
    reward = torch.zeros(len(here))
    partner = torch.from_numpy(view.second[pairs])
    reward[torch.from_numpy(view.first[pairs])] = torch.from_numpy(worth).float() * there[partner]
    return reward


def mutual_pairs(
    view: ViewCandidates, radius_px: float, possible_here: np.ndarray, possible_there: np.ndarray
) -> np.ndarray:
    """Return which (P,) join mutual nearest neighbours among the possible candidates (N,), (M,)."""
    close = view.distance_px <= radius_px
    rows = np.flatnonzero(close & possible_here[view.first] & possible_there[view.second])
    rows = rows[np.argsort(view.distance_px[rows], kind="stable")]
    # The first of each candidate is its nearest.
    _, best_first = np.unique(view.first[rows], return_index=True)
    _, best_second = np.unique(view.second[rows], return_index=True)
    found: np.ndarray = rows[np.intersect1d(best_first, best_second)]
    return found
