"""The loss of a pair of views: less the expected fraction of keypoints that are found again.

Candidates and their positions are fixed; only their order is learned. The logits have a fixed
standard deviation, so the loss does not fall when the ranker only makes its logits sharper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...detector.points.detection import least_distances
from ...features.selection import suppress_neighbors
from .pairs import CandidatePair, Correspondences, Side

CLOSE_PX, NEAR_PX = 1.0, 3.0

SHARPNESS = 25.0
"""Standard deviation of the logits over the keypoints of a view, to which they are scaled before
the loss: it cannot be lowered by sharper logits."""

TEMPERATURE = 0.6
"""Of the soft choice of the best, in units of those logits."""

CLOSE_SHARE = 0.7
"""Of the reward of a keypoint that is found again within 3 px, what it gets only within 1 px."""

MIN_CHOICE = 0.1
"""Candidates that are chosen with less than this have and are no partners."""

MIN_SPREAD = 1e-3
BISECTIONS = 40


@dataclass(frozen=True)
class Chosen:
    """The keypoints of a view at a budget.

    Attributes:
        share: (N,) of all candidates: how surely each is among the best, differentiable; 0 for
            those that a better one is near.
        visible: (N,) bool: those that the other view shows.
    """

    share: Tensor
    visible: Tensor


def pair_loss(
    ranker: torch.nn.Module, pair: CandidatePair, density: float, match_weight: float
) -> Tensor:
    """Return the loss of a pair of views, seen in both directions.

    Its value is what is expected to be found again; its gradient is that at a fixed budget: a
    candidate that becomes more likely drives out others at the border of the budget, so its reward
    counts less theirs.

    Args:
        ranker: from (N, F) features to (N,) logits.
        pair: the candidates of both views, and which see the same place.
        density: keypoints per pixel.
        match_weight: as of `PointsTrainingOptions`.
    """
    chosen = [
        _choose(ranker, side, way, density * pair.area)
        for side, way in zip(pair.sides, pair.ways, strict=True)
    ]
    mass = min(float(each.share.detach()[each.visible].sum()) for each in chosen)
    total = chosen[0].share.sum() * 0
    for way, here, there in zip(pair.ways, chosen, chosen[::-1], strict=True):
        share = here.share.detach()
        reward = _rewards(way, share, there.share.detach(), match_weight)
        border = share * (1 - share) * here.visible
        level = (reward * border).sum() / border.sum().clamp(min=1e-6)
        value = (share * reward * here.visible).sum() / max(mass, 1.0)
        gain = (here.share * (reward - level) * here.visible).sum() / max(mass, 1.0)
        total = total - value - (gain - gain.detach())
    return total / 2


def _choose(ranker: torch.nn.Module, side: Side, way: Correspondences, budget: float) -> Chosen:
    logits = ranker(torch.from_numpy(side.features))
    radii = least_distances(side.sigma_px)  # as at run time
    kept = torch.from_numpy(suppress_neighbors(side.xy, logits.detach().numpy(), radii))
    fixed = logits[kept].detach()
    spread = fixed.std() if len(fixed) > 1 else fixed.new_ones(())
    scaled = (logits[kept] - fixed.mean()) * (SHARPNESS / spread.clamp(min=MIN_SPREAD))
    share = torch.zeros(len(logits)).index_put((kept,), soft_top_k(scaled, budget, TEMPERATURE))
    return Chosen(share, torch.from_numpy(way.visible))


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


def _rewards(way: Correspondences, here: Tensor, there: Tensor, match_weight: float) -> Tensor:
    """Return what a candidate is worth: its partner's choice, by the distances of the measure.

    One to one, as it is measured, and among those that may be chosen: with a sum over all near
    candidates, crowds of points are rewarded, and fewer points are found again within 1 px.
    """
    possible = [each.numpy() > MIN_CHOICE for each in (here, there)]
    pairs = mutual_pairs(way, NEAR_PX, possible[0], possible[1])
    close = way.distance_px[pairs] <= CLOSE_PX
    worth = 1 - CLOSE_SHARE + CLOSE_SHARE * close
    worth *= (1 + match_weight * way.matchable[pairs]) / (1 + match_weight)
    reward = torch.zeros(len(here))
    partner = torch.from_numpy(way.second[pairs])
    reward[torch.from_numpy(way.first[pairs])] = torch.from_numpy(worth).float() * there[partner]
    return reward


def mutual_pairs(
    way: Correspondences,
    radius_px: float,
    possible_here: np.ndarray,
    possible_there: np.ndarray,
) -> np.ndarray:
    """Return which correspondences join mutual nearest neighbours.

    Args:
        way: from one view to the other.
        radius_px: the largest distance.
        possible_here, possible_there: (N,), (M,) bool: which candidates count.
    """
    close = way.distance_px <= radius_px
    rows = np.flatnonzero(close & possible_here[way.first] & possible_there[way.second])
    rows = rows[np.argsort(way.distance_px[rows], kind="stable")]
    # The first of each candidate is its nearest.
    _, best_first = np.unique(way.first[rows], return_index=True)
    _, best_second = np.unique(way.second[rows], return_index=True)
    found: np.ndarray = rows[np.intersect1d(best_first, best_second)]
    return found
