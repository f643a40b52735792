"""The loss of a pair of views: minus the expected fraction of keypoints that are found again.

The candidates and their positions are fixed. The network only learns to rank them, by logits.
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
"""The logits of a view's keypoints are scaled to this standard deviation before the loss, so that
larger logits alone do not lower the loss. `TEMPERATURE` was chosen for this value."""

TEMPERATURE = 0.6
"""Temperature of the sigmoid of scaled logits. After 1,000 steps, the repeatability on photos/val
was 0.560 with 0.6, and 0.546 to 0.552 with 0.15, 0.3, 1, 1.5 and 3 (lab/HISTORY.md)."""

CLOSE_SHARE = 0.7
"""A keypoint gets this share of its reward only if it is found again within `CLOSE_PX`. It gets the
rest if it is found again within `NEAR_PX`. Chosen by hand."""

MIN_CHOICE = 0.1
"""Candidates chosen with a smaller probability are not matched between views. Chosen by hand."""

MIN_SPREAD = 1e-3
BISECTIONS = 40


def pair_loss(ranker: torch.nn.Module, pair: CandidatePair) -> Tensor:
    """Return the loss of a pair of views, averaged over both directions between the views.

    The gradient keeps the number of keypoints fixed: a candidate that becomes more likely displaces
    candidates near the selection threshold, so their mean reward is subtracted from its own reward.
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
    """Return selection probabilities (N,), 0 for candidates suppressed by a better one nearby."""
    logits = ranker(torch.from_numpy(view.features))
    radii = least_distances(view.sigma_px)  # the same distances as in detection
    kept = torch.from_numpy(suppress_neighbors(view.xy, logits.detach().numpy(), radii))
    fixed = logits[kept].detach()
    spread = fixed.std() if len(fixed) > 1 else fixed.new_ones(())
    scaled = (logits[kept] - fixed.mean()) * (SHARPNESS / spread.clamp(min=MIN_SPREAD))
    return torch.zeros(len(logits)).index_put((kept,), soft_top_k(scaled, budget, TEMPERATURE))


def soft_top_k(logits: Tensor, budget: float, temperature: float) -> Tensor:
    """Return sigmoid((logits - tau) / temperature), with tau such that the sum is `budget`.

    If there are at most `budget` logits, all values are close to 1.
    """
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
    """Return the reward (N,) of each candidate: the probability that its partner is chosen.

    The reward is lower if the partner is farther than 1 px away. Partners are mutual nearest
    neighbours among the candidates that may be chosen: if all near candidates counted, clusters of
    candidates would be rewarded.
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
    """Return which pairs of candidates are mutual nearest neighbours within a radius.

    The result holds indices into `view.first` and `view.second`. Only candidates that are marked in
    the masks count: `possible_here` (N,) for this view, `possible_there` (M,) for the other view.
    """
    close = view.distance_px <= radius_px
    rows = np.flatnonzero(close & possible_here[view.first] & possible_there[view.second])
    rows = rows[np.argsort(view.distance_px[rows], kind="stable")]
    # The pairs are sorted by distance, so the first pair of a candidate has its nearest neighbour.
    _, best_first = np.unique(view.first[rows], return_index=True)
    _, best_second = np.unique(view.second[rows], return_index=True)
    found: np.ndarray = rows[np.intersect1d(best_first, best_second)]
    return found
