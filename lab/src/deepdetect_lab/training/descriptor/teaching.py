"""The losses of a network that is taught: codes and order of the teachers, and its own angles."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cosine_similarity, normalize

from ..teachers.readings import CODE_LENGTHS
from .crops import Crops
from .losses import contrast, maps_of, mirror_half, read_views
from .network import turn
from .taught import TaughtNetwork
from .views import Pair

CODE_WEIGHT, RELATION_WEIGHT = 6.0, 20.0
"""Weights of 1 - cosine to each teacher's code, and of the squared differences of similarities
within a photograph. With them, both gradients are half as large after 100 steps as that of the
contrastive loss, whose weight is 1."""

RIGHT_COSINE = 0.94
"""The cosine of 20 degrees, an error by which own-angle descriptors hardly lose matches."""


def crop_losses(network: TaughtNetwork, crops: Crops) -> dict[str, Tensor]:
    """Return the losses by which the network learns from the teachers."""
    maps = maps_of(network, crops.images)
    features = network.features(maps, crops.positions, crops.sizes)
    code = network.code(features, crops.positions)
    cosines = similarity_to_teachers(network, code, crops)
    # Two codes of length 1 side by side have twice the mean of both similarities.
    theirs = crops.codes.float()
    relations = code @ code.transpose(1, 2) - theirs @ theirs.transpose(1, 2) / len(CODE_LENGTHS)
    scores = network.scores(maps, crops.positions, crops.sizes)
    return {
        "codes": CODE_WEIGHT * (1 - cosines).mean(0).sum(),
        "relations": RELATION_WEIGHT * relations.square().mean(),
        "up": (1 - up_is_found(network, features, crops)).mean(),
        "survival": binary_cross_entropy_with_logits(scores, crops.survival),
    }


def similarity_to_teachers(network: TaughtNetwork, code: Tensor, crops: Crops) -> Tensor:
    """Return (B * N, 2) cosines of the predicted codes of the teachers with the real ones.

    The teachers have seen the photographs upright, so the descriptors are turned back.
    """
    upright = turn(code, -crops.turn[:, None])
    parts = (each.split(CODE_LENGTHS, -1) for each in (network.teach(upright), crops.codes.float()))
    both = (cosine_similarity(found, known, -1) for found, known in zip(*parts, strict=True))
    return torch.stack(list(both), -1).flatten(0, 1)


def up_is_found(network: TaughtNetwork, features: Tensor, crops: Crops) -> Tensor:
    """Return (B, N) cosines of the errors of angles, if that of an upright photograph is 0."""
    x, y = normalize(network.angle(features), dim=-1).view(*crops.sizes.shape, 2).unbind(-1)
    return x * crops.turn.cos()[:, None] + y * crops.turn.sin()[:, None]


def pair_losses(
    network: TaughtNetwork, batch: Pair, generator: np.random.Generator
) -> dict[str, Tensor]:
    """Return the losses of pairs of views: their descriptors', and those of their angles."""
    batch = mirror_half(batch, generator)
    features, positions = read_views(network, batch)
    first, second = network.code(features, positions).chunk(2)
    agreement = angles_agree(network.angle(features).unflatten(0, positions.shape[:2]), batch)
    return {
        "pairs": contrast(network, (first, second), batch, generator),
        "angles": (1 - agreement)[batch.valid].mean(),
    }


def angles_agree(directions: Tensor, batch: Pair) -> Tensor:
    """Return (B, N) cosines of the errors of the rotations that angles of both views predict.

    Directions (2 * B, N, 2) are vectors whose angle is that of a keypoint.
    """
    (x0, y0), (x1, y1) = (each.unbind(-1) for each in normalize(directions, dim=-1).chunk(2))
    along, across = x0 * x1 + y0 * y1, x0 * y1 - y0 * x1
    return along * batch.turns.cos() + across * batch.turns.sin()


@torch.no_grad()
def measure_teaching(
    network: TaughtNetwork, crops: Iterable[Crops], pairs: Iterable[Pair]
) -> dict[str, float]:
    """Return how well an averaged network has learned, on validation crops and pairs.

    The measures are the mean cosine to the teachers' codes, the correlation of scores with ALIKED's
    order, and the share of keypoints whose predicted rotation is correct within 20 degrees.
    """
    cosines, correlations, right = [], [], []
    for batch in crops:
        maps = maps_of(network, batch.images)
        code = network.code(network.features(maps, batch.positions, batch.sizes), batch.positions)
        cosines.append(similarity_to_teachers(network, code, batch).mean(0))
        scores = network.scores(maps, batch.positions, batch.sizes)
        for found, known in zip(scores, batch.survival, strict=True):
            ranks = found.argsort().argsort().float()
            correlations.append(torch.corrcoef(torch.stack([ranks, known]))[0, 1])
    for pair in pairs:
        features, positions = read_views(network, pair)
        directions = network.angle(features).unflatten(0, positions.shape[:2])
        agree = angles_agree(directions, pair) > RIGHT_COSINE
        right.append(agree[pair.valid].float().mean())
    names = "edgepoint score", "aliked score", "order score", "angles correct"
    means = (*torch.stack(cosines).mean(0), *(torch.stack(x).mean() for x in (correlations, right)))
    return dict(zip(names, map(float, means), strict=True))
