"""Losses over pairs of views, both blind to the scale of the logits.

The candidates' logits have a fixed standard deviation, so neither loss falls when the network only
makes its logits sharper.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import smooth_l1_loss, softplus

from .candidates import Candidates
from .recipe import PointsTrainingOptions

REACH_PX = 3.0
CLOSE_PX, NEAR_PX = 1.0, 3.0
MIN_CHOICE = 0.1
"""Candidates that are chosen with less than this have and are no partners."""

BISECTIONS = 40
COMPARISONS = 4096
NEAR_BUDGET = 3.0
"""The ranking loss compares candidates among this many times the budget."""

CONSISTENCY_WEIGHT = 0.3


@dataclass(frozen=True)
class Correspondences:
    """Candidates of one view that see one of the other, by distance in the other.

    Attributes:
        first, second: (P,) rows of both views.
        distance_px: (P,) in pixels of the view that the first one is projected into.
        visible: (N,) whether the other view shows a candidate of the first.
    """

    first: np.ndarray
    second: np.ndarray
    distance_px: np.ndarray
    visible: np.ndarray


@dataclass(frozen=True)
class Direction:
    """One view's candidates, those of the other, and the way from here to there.

    Attributes:
        here, there: candidates.
        homography: (3, 3) float64 from here to there.
        valid: (H, W) bool of the view there.
    """

    here: Candidates
    there: Candidates
    homography: np.ndarray
    valid: np.ndarray

    @cached_property
    def mapped(self) -> Tensor:
        """The candidates' positions in the view there, differentiable."""
        return project(self.here.xy, self.homography)

    @cached_property
    def near(self) -> Correspondences:
        """The candidates there within `REACH_PX`."""
        from scipy.spatial import KDTree

        mapped = self.mapped.detach().numpy().astype(np.float64)
        places = self.there.xy.detach().numpy().astype(np.float64)
        height, width = self.valid.shape
        finite: np.ndarray = np.all(np.isfinite(mapped) & (np.abs(mapped) < 1e6), axis=1)
        column, row = np.rint(np.where(finite[:, None], mapped, -1)).astype(int).T
        inside = finite & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        rows = np.flatnonzero(inside)
        rows = rows[self.valid[row[rows], column[rows]]]
        visible = np.zeros(len(mapped), bool)
        visible[rows] = True
        if not len(rows) or not len(places):
            none = np.zeros(0, np.int64)
            return Correspondences(none, none, np.zeros(0), visible)
        found = KDTree(mapped[rows]).sparse_distance_matrix(
            KDTree(places), REACH_PX, output_type="coo_matrix"
        )
        return Correspondences(rows[found.row], found.col.astype(np.int64), found.data, visible)


def project(xy: Tensor, homography: np.ndarray) -> Tensor:
    """Map (N, 2) positions by a (3, 3) homography, differentiably."""
    matrix = torch.from_numpy(homography / homography[2, 2]).to(xy.dtype)
    mapped = xy @ matrix[:, :2].T + matrix[:, 2]
    return mapped[:, :2] / mapped[:, 2:]


def pair_loss(
    first: Direction, second: Direction, density: float, options: PointsTrainingOptions
) -> Tensor:
    """Return the loss of a pair of views, seen in both directions.

    Args:
        first, second: from one view to the other, and back.
        density: keypoints per pixel.
        options: which loss, and its settings.
    """
    budget = density * first.valid.size
    if options.loss == "budget":
        loss = budget_loss(first, second, budget, options.temperature)
    else:
        loss = ranking_loss(first, second, budget, options.temperature)
    if options.position_weight:
        loss = loss + options.position_weight * position_loss(first, second, options.temperature)
    return loss


def choose_softly(logits: Tensor, budget: float, temperature: float) -> Tensor:
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


def budget_loss(first: Direction, second: Direction, budget: float, temperature: float) -> Tensor:
    """Return less the expected fraction of repeats at a budget, with its exact gradient.

    A candidate that becomes more likely drives out others at the border of the budget: its
    reward counts less theirs.
    """
    chosen = [choose_softly(way.here.logits, budget, temperature) for way in (first, second)]
    seen = [torch.from_numpy(way.near.visible) for way in (first, second)]
    mass = min(float(g.detach()[v].sum()) for g, v in zip(chosen, seen, strict=True))
    total = first.here.logits.sum() * 0
    for way, g, other, visible in zip((first, second), chosen, chosen[::-1], seen, strict=True):
        reward = _rewards(way, g.detach(), other.detach())
        border = (g * (1 - g)).detach() * visible
        level = (reward * border).sum() / border.sum().clamp(min=1e-6)
        gain = (g * (reward - level) * visible).sum() / max(mass, 1.0)
        # The value is what is expected to be found again; the gradient that at a fixed budget.
        value = (g.detach() * reward * visible).sum() / max(mass, 1.0)
        total = total - value - (gain - gain.detach())
    return total / 2


def _rewards(way: Direction, chosen_here: Tensor, chosen_there: Tensor) -> Tensor:
    """Return what a candidate is worth: its partner's choice, by the distances of the measure.

    One to one, as it is measured, and among those that may be chosen: with a sum over all near
    candidates, crowds of points are rewarded, and fewer points are found again within 1 px.
    """
    possible = [each.detach().numpy() > MIN_CHOICE for each in (chosen_here, chosen_there)]
    rows, partners, distance = mutual_pairs(way, NEAR_PX, possible[0], possible[1])
    worth = torch.from_numpy(0.3 + 0.7 * (distance <= CLOSE_PX)).float()
    reward = torch.zeros(len(way.here.logits))
    reward[torch.from_numpy(rows)] = worth * chosen_there[torch.from_numpy(partners)]
    return reward


def mutual_pairs(
    way: Direction,
    radius_px: float,
    possible_here: np.ndarray | None = None,
    possible_there: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows of both views that are mutual nearest neighbours, and their distances.

    Args:
        way: from one view to the other.
        radius_px: the largest distance.
        possible_here, possible_there: (N,), (M,) bool: which candidates count; all by default.
    """
    near = way.near
    close = near.distance_px <= radius_px
    if possible_here is not None:
        close = close & possible_here[near.first]
    if possible_there is not None:
        close = close & possible_there[near.second]
    first, second, distance = near.first[close], near.second[close], near.distance_px[close]
    order = np.argsort(distance, kind="stable")
    first, second, distance = first[order], second[order], distance[order]
    # The first of each row is its nearest.
    _, best_first = np.unique(first, return_index=True)
    _, best_second = np.unique(second, return_index=True)
    both = np.intersect1d(best_first, best_second)
    return first[both], second[both], distance[both]


def ranking_loss(first: Direction, second: Direction, budget: float, temperature: float) -> Tensor:
    """Compare candidates pair by pair: those found again among the other view's best come first.

    And a candidate and its partner have the same logit: what is best must be so in both views.
    """
    total = first.here.logits.sum() * 0
    for way in (first, second):
        here, there = way.here.logits, way.there.logits
        rows, partners, distance = mutual_pairs(way, NEAR_PX)
        rank_there = _ranks(there)
        found = np.zeros(len(here), np.float32)
        repeated = rank_there[partners] < budget
        found[rows[repeated]] = 0.4 + 0.6 * (distance[repeated] <= CLOSE_PX)
        compared = np.flatnonzero(way.near.visible & (_ranks(here) < NEAR_BUDGET * budget))
        if len(compared) > 1:
            generator = np.random.default_rng(len(compared))
            a, b = compared[generator.integers(len(compared), size=(2, COMPARISONS))]
            gain = torch.from_numpy(found[a] - found[b]).clamp(min=0)
            wrong = softplus((here[torch.from_numpy(b)] - here[torch.from_numpy(a)]) / temperature)
            total = total + (gain * wrong).sum() / gain.sum().clamp(min=1)
        if len(rows):
            gap = (here[torch.from_numpy(rows)] - there[torch.from_numpy(partners)]) / temperature
            total = total + CONSISTENCY_WEIGHT * smooth_l1_loss(gap, torch.zeros_like(gap))
    return total / 2


def _ranks(logits: Tensor) -> np.ndarray:
    ranks = np.empty(len(logits), np.int64)
    ranks[np.argsort(-logits.detach().numpy(), kind="stable")] = np.arange(len(logits))
    return ranks


def position_loss(first: Direction, second: Direction, temperature: float) -> Tensor:
    """Return the mean distance of partners in pixels, those with high logits first."""
    total = first.here.logits.sum() * 0
    for way in (first, second):
        rows, partners, _ = mutual_pairs(way, NEAR_PX)
        if not len(rows):
            continue
        row, partner = torch.from_numpy(rows), torch.from_numpy(partners)
        weight = torch.minimum(way.here.logits[row], way.there.logits[partner]).detach()
        weight = torch.sigmoid(weight / (2 * temperature))
        gap = way.mapped[row] - way.there.xy[partner]
        distance = (gap.square().sum(1) + 1e-4).sqrt()
        total = total + (weight * distance).sum() / weight.sum().clamp(min=1)
    return total / 2
