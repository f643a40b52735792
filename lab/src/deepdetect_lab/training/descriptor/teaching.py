"""The losses by which a network learns its teachers' descriptors (codes) and ranking of points."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, kl_div, log_softmax, normalize

from .crops import Crops
from .losses import maps_of
from .network import DescriptorNetwork, turn

PAIR_WEIGHT, CODE_WEIGHT, RELATION_WEIGHT, NEIGHBOUR_WEIGHT = 5.0, 14.0, 45.0, 3.0
"""Weights of losses: the contrastive loss of pairs; 1 - cosine to the teachers' codes; the squared
differences of similarities of points within a crop; the differences of nearest neighbours. With the
pair weight 1, Oxford's ten zoomed pairs had 518 correct matches; with 5 and a third octave 566 (545
by the octave alone). With the other weights a third smaller, the share of points of photos/val
whose predicted code is nearest to their own rose by 0.001 in 1,000 steps; with these weights and a
falling learning rate, it rose by 0.005 in 1,200 steps."""

SHARPNESS = 10.0
"""Similarities are multiplied by this factor before a softmax over the neighbours, so that a
neighbour with a similarity 0.1 below the highest counts a third as much. Chosen by hand."""

SAME = 1e-6
"""Similarities that differ by less than this count as equal: a point may be in a crop twice."""


def crop_losses(network: DescriptorNetwork, crops: Crops) -> dict[str, Tensor]:
    """Return, by name, the weighted losses by which the network learns from the teachers."""
    maps = maps_of(network, crops.images)
    features = network.features(maps, crops.positions, crops.sizes)
    code = network.code(features, crops.positions)
    theirs, found = crops.codes, predict_codes(network, code, crops)
    known, own = theirs @ theirs.transpose(1, 2), code @ code.transpose(1, 2)
    scores = network.scores(maps, crops.positions, crops.sizes)
    return {
        "codes": CODE_WEIGHT * (1 - (found * theirs).sum(-1)).mean(),
        "relations": RELATION_WEIGHT * (own - known).square().mean(),
        "own neighbours": NEIGHBOUR_WEIGHT
        * neighbours_differ(without_self(own), without_self(known)),
        "neighbours": NEIGHBOUR_WEIGHT * neighbours_differ(found @ theirs.transpose(1, 2), known),
        "survival": binary_cross_entropy_with_logits(scores, crops.survival),
    }


def predict_codes(network: DescriptorNetwork, code: Tensor, crops: Crops) -> Tensor:
    """Return (B, N, 192) predicted codes of the teachers, of length 1.

    The teachers saw the photographs before rotation, so the descriptors are rotated back.
    """
    return normalize(network.teach(turn(code, -crops.turn[:, None])), dim=-1)


def without_self(similarities: Tensor) -> Tensor:
    """Set the similarity of each point to itself to -1, in similarities (B, N, N)."""
    own = torch.eye(similarities.shape[1], dtype=torch.bool, device=similarities.device)
    return similarities.masked_fill(own, -1)


def neighbours_differ(found: Tensor, known: Tensor) -> Tensor:
    """Return how much the nearest neighbours differ between two similarity matrices (B, N, N).

    The measure is the mean Kullback-Leibler divergence of the softmax of their rows.
    """
    chances, wanted = (log_softmax(SHARPNESS * each, -1).flatten(0, 1) for each in (found, known))
    return kl_div(chances, wanted, reduction="batchmean", log_target=True)


@torch.no_grad()
def measure_teaching(network: DescriptorNetwork, crops: Iterable[Crops]) -> dict[str, float]:
    """Measure, on validation crops, how well a network in evaluation mode has learned.

    The measures are the mean cosine of predicted codes to the teachers' codes, the share of points
    whose predicted code is nearest to the teachers' code of the same point, and the correlation of
    the ranks of scores with those of ALIKED's scores.
    """
    cosines, nearest, correlations = [], [], []
    for batch in crops:
        maps = maps_of(network, batch.images)
        code = network.code(network.features(maps, batch.positions, batch.sizes), batch.positions)
        similar = predict_codes(network, code, batch) @ batch.codes.transpose(1, 2)
        own = similar.diagonal(dim1=1, dim2=2)
        cosines.append(own.mean())
        nearest.append((own >= similar.amax(2) - SAME).float().mean())
        scores = network.scores(maps, batch.positions, batch.sizes)
        for found, known in zip(scores, batch.survival, strict=True):
            ranks = found.argsort().argsort().float()
            correlations.append(torch.corrcoef(torch.stack([ranks, known]))[0, 1])
    names = "teachers score", "teachers found", "order score"
    means = (torch.stack(values).mean() for values in (cosines, nearest, correlations))
    return dict(zip(names, map(float, means), strict=True))
