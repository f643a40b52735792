"""The contrastive loss of pairs of views, and the validation metric: shares of correct matches."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import cross_entropy

from ..scenes import SIDE_PX
from .network import DescriptorNetwork, turn
from .views import Pair

NEAR_PX = 3.0
"""Two keypoints that are closer than this in either view are not negatives of each other in the
loss. In the metric, a match is correct if it is closer than this to the true position."""

MAX_LOG_TEMPERATURE = 4.3
"""Maximum of log(1 / temperature): similarities are multiplied by at most 74. Chosen by hand."""

UPRIGHT, ANGLE_NOISE = 0.45, 0.15
"""Pairs of views with a rotation below `UPRIGHT` radians count as upright. `ANGLE_NOISE` is the
standard deviation, in radians, of simulated errors of keypoint angles. Both are chosen by hand."""

KINDS = ("upright", "turned", "zoomed")


def kind_of(angle: float, zoom: float) -> str:
    """Return one of `KINDS` for the absolute rotation (radians) and log zoom between two views."""
    if zoom > 0.6:  # the log of a zoom by a factor of 1.8
        return "zoomed"
    return "upright" if angle < UPRIGHT else "turned"


def describe_views(network: DescriptorNetwork, batch: Pair) -> tuple[Tensor, Tensor]:
    """Return descriptors (B, N, 64) of the keypoints of each view; rotations are not undone."""
    images = batch.images.transpose(0, 1).flatten(0, 1)
    positions = torch.cat([batch.positions0, batch.positions1])
    sizes = torch.cat([batch.sizes0, batch.sizes1])
    features = network.features(maps_of(network, images), positions, sizes)
    first, second = network.code(features, positions).chunk(2)
    return first, second


def maps_of(network: DescriptorNetwork, images: Tensor) -> list[list[Tensor]]:
    """Return the network's feature maps of images (B, S, S) uint8, computed in bfloat16."""
    values = images[:, None].float() / 255
    with torch.autocast(images.device.type, torch.bfloat16):
        return network.maps(values.contiguous(memory_format=torch.channels_last))


def mirror(batch: Pair, which: Tensor) -> Pair:
    """Mirror left to right the pairs of a batch that are marked in `which`, (B,) bool."""

    def mirrored(xy: Tensor) -> Tensor:
        x, y = xy.unbind(-1)
        return torch.stack([torch.where(which[:, None], SIDE_PX - 1 - x, x), y], -1)

    return batch._replace(
        images=torch.where(which[:, None, None, None], batch.images.flip(-1), batch.images),
        positions0=mirrored(batch.positions0),
        positions1=mirrored(batch.positions1),
        turns=torch.where(which[:, None], -batch.turns, batch.turns),
    )


def contrastive_loss(
    network: DescriptorNetwork, batch: Pair, generator: np.random.Generator
) -> Tensor:
    """Return the symmetric InfoNCE loss, the cross-entropy of the true match among all keypoints.

    Half of the pairs are mirrored. The descriptors of the second view are rotated back by the
    rotation between the views at each keypoint, with random errors like those of a detector. Half
    of the pairs that are rotated by less than `UPRIGHT` are not rotated back, because in use
    upright images are described without rotation.
    """
    mirrored = torch.from_numpy(generator.random(len(batch.turn)) < 0.5)
    batch = mirror(batch, mirrored.to(batch.turn.device))
    device, (first, second) = batch.turns.device, describe_views(network, batch)
    kept = torch.from_numpy(generator.random(len(batch.turn)) < 0.5).to(device)
    noise = torch.from_numpy(generator.normal(0, ANGLE_NOISE, batch.turns.shape)).to(device)
    as_is = kept & (batch.turn < UPRIGHT)
    second = turn(second, torch.where(as_is[:, None], 0, -(batch.turns + noise.float())))
    similar = (
        first @ second.transpose(1, 2) * network.temperature.clamp(max=MAX_LOG_TEMPERATURE).exp()
    )
    valid, size = batch.valid, batch.valid.shape[1]
    near = _near(batch.positions0) | _near(batch.positions1)
    wrong = near & ~torch.eye(size, dtype=torch.bool, device=device) | ~valid[:, None]
    own = torch.arange(size, device=device).expand(valid.shape)[valid]
    both = (each.masked_fill(wrong, -1e4)[valid] for each in (similar, similar.transpose(1, 2)))
    forth, back = (cross_entropy(each, own) for each in both)
    return (forth + back) / 2


def _near(xy: Tensor) -> Tensor:
    return (xy[:, :, None] - xy[:, None]).square().sum(-1) < NEAR_PX**2


@torch.no_grad()
def shares_right(network: DescriptorNetwork, batches: Iterable[Pair]) -> dict[str, float]:
    """Return the share of keypoints whose mutual nearest neighbour is correct, by kind of pair.

    The network must be in evaluation mode, and `batches` must hold pairs of each of `KINDS`.
    """
    shares: dict[str, list[float]] = {kind: [] for kind in KINDS}
    generator = np.random.default_rng(1)
    for batch in batches:
        first, second = describe_views(network, batch)
        noise = generator.normal(0, ANGLE_NOISE, batch.turns.shape).astype(np.float32)
        angles = batch.turns + torch.from_numpy(noise).to(second.device)
        turned = turn(second, -angles)
        for row, valid in enumerate(batch.valid):
            angle, zoom = batch.turn[row].item(), batch.zoom[row].item()
            other = (second if angle < UPRIGHT else turned)[row][valid]
            similar, places = first[row][valid] @ other.T, batch.positions1[row][valid]
            nearest = similar.argmax(1)
            mutual = similar.argmax(0)[nearest] == torch.arange(len(nearest), device=other.device)
            right = mutual & ((places[nearest] - places).norm(dim=1) < NEAR_PX)
            shares[kind_of(angle, zoom)].append(right.float().mean().item())
    return {f"{kind} correct": float(np.mean(values)) for kind, values in shares.items()}
