"""The training task of the matcher: its loss, the variation of pairs, and its validation."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize
from torch.utils.data import DataLoader, Dataset

from deepdetect._shared.records import key
from deepdetect.features.learned import LENGTH

from ...networks.weights import load_network, weights_digest
from ..match_filter import VALIDATION_SEED
from ..recipe import MatcherTrainingOptions
from ..sampler import milestones
from ..synthetic import happens, rotation
from ..trainer import Trainer, digests, seeded, with_plateau
from .network import Matcher, export_matcher
from .pairs import NONE, UNKNOWN, Pair, draw_pairs, files_of_places, read_pair

ONNX = "attention.onnx"

WARM_UP_STEPS, DECAY_SHARE, WEIGHT_DECAY, AVERAGE_DECAY = 50, 0.4, 0.01, 0.998
"""The learning rate rises over the first WARM_UP_STEPS steps, and falls linearly to 0 over the last
share DECAY_SHARE of the steps. AdamW has the default weight decay of torch. The weights that are
kept are averages over some 500 steps. Chosen by hand."""

FIRST_FACTOR = 5.0
"""The layers that read descriptors and traits learn this much faster than the others, because they
start with random weights if all others are trained. Chosen by hand."""

KEPT, SHUFFLED_SHARE = (0.3, 0.7), 0.3
"""A random share of the keypoints in this range is kept, so that a step takes a quarter of the
time: the best ones, or in the share SHUFFLED_SHARE of the images any. Chosen by hand."""

ANGLE, LOG_ZOOM = 0.15, 0.1
"""Standard deviations of the rotation of both images, in radians, and of the logarithm of their
zoom. Chosen by hand."""

NOISY_SHARE, NOISE, MIX = 0.7, 0.1, 0.12
"""Descriptors get noise in the share NOISY_SHARE of the pairs: random numbers with a standard
deviation up to NOISE, and a random linear map of the descriptors up to MIX. The descriptors of one
place then become as unlike as under another light or season: median cosines of 0.6 in place of 0.8,
as in the data set `wide`."""

MIN_PROBABILITY = 0.3
"""Validations count matches of at least this probability: at 0.3, they were as precise as those of
the ratio test on HPatches and Oxford."""


class PairDataset(Dataset[list[tuple[dict[str, Tensor], Tensor, Tensor]]]):
    """The batch of each step: random pairs, randomly varied. The seed and the step determine it."""

    def __init__(self, files: Sequence[Path], options: MatcherTrainingOptions) -> None:
        self.files, self.options = files, options

    def __getitem__(self, step: int) -> list[tuple[dict[str, Tensor], Tensor, Tensor]]:
        rng = np.random.default_rng([self.options.seed, 3, step])
        chosen = rng.integers(0, len(self.files), self.options.pairs)
        return [as_tensors(vary(rng, read_pair(self.files[row]))) for row in chosen]


def vary(rng: np.random.Generator, pair: Pair) -> Pair:
    """Leave out keypoints, swap, rotate and zoom both images, and make descriptors less alike."""
    sides = [{name[:-1]: a for name, a in pair.inputs.items() if name[-1] == s} for s in "01"]
    partners = [pair.partners0.astype(np.int64), pair.partners1.astype(np.int64)]
    kept = []
    for own in partners:
        count = int(len(own) * rng.uniform(*KEPT))
        order = rng.permutation(len(own)) if happens(rng, SHUFFLED_SHARE) else np.arange(len(own))
        kept.append(np.sort(order[:count]))
    turn = rotation(rng.normal(0, ANGLE)) * math.exp(rng.normal(0, LOG_ZOOM))
    noisy, noise, mix = happens(rng, NOISY_SHARE), NOISE * rng.random(), MIX * rng.random()
    varied = []
    for side, rows in enumerate(kept):
        inputs: dict[str, np.ndarray] = {}
        for name, array in sides[side].items():
            inputs[name] = array[rows].astype(np.float32)
        inputs["xy"] = inputs["xy"] @ turn.T.astype(np.float32)
        if noisy:
            described = inputs["descriptors"]
            if side:
                mixing = rng.standard_normal((LENGTH, LENGTH), np.float32)
                described = described + mix * described @ mixing
            described = normalize(torch.from_numpy(described), dim=1).numpy()
            described = described + noise * rng.standard_normal(described.shape, np.float32)
            inputs["descriptors"] = normalize(torch.from_numpy(described), dim=1).numpy()
        # Partners that were left out no longer exist.
        places = np.full(len(partners[1 - side]), NONE)
        places[kept[1 - side]] = np.arange(len(kept[1 - side]))
        own = partners[side][rows]
        varied.append((inputs, np.where(own >= 0, places[own], own)))
    if happens(rng, 0.5):
        varied.reverse()
    joined = {f"{name}{k}": a for k, (inputs, _) in enumerate(varied) for name, a in inputs.items()}
    return Pair(joined, varied[0][1], varied[1][1])


def as_tensors(pair: Pair) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Return the inputs of a pair by name, and the partners in both images, as tensors."""
    inputs = {name: torch.from_numpy(a.astype(np.float32)) for name, a in pair.inputs.items()}
    partners0, partners1 = (torch.from_numpy(each.astype(np.int64)) for each in pair[1:])
    return inputs, partners0, partners1


def loss_of(
    network: Matcher, inputs: dict[str, Tensor], partners0: Tensor, partners1: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the loss of a pair and (N, M) log probabilities.

    The loss is the mean over keypoints with a partner, and over those without one, of the negative
    logarithm of the probability of what is right.
    """
    scores, any0, any1 = network(**inputs)
    rows = (partners0 >= 0).nonzero()[:, 0]
    parts = [-scores[rows, partners0[rows]].mean()] if len(rows) else []
    alone = [-logsigmoid(-own[p == NONE]) for own, p in ((any0, partners0), (any1, partners1))]
    joined = torch.cat(alone)
    parts += [joined.mean()] if len(joined) else []
    return torch.stack(parts).mean() if parts else 0 * scores.sum(), scores


class MatcherTrainer(Trainer):
    """Training of the matcher on pairs of synthetic views, and of real photographs of places."""

    objective, sign = "validation_loss", 1
    purpose = "that matches keypoints by attention"
    measures = (
        "On pairs of synthetic views of the validation images: the loss; the fraction of the "
        "corresponding keypoints that are matched, and of the matches that are right; the mean "
        "number of matches of unrelated views"
    )
    weights_file = "attention.safetensors"
    max_gradient_norm = 1.0
    average_decay = AVERAGE_DECAY
    network: Matcher
    average: Matcher

    def __init__(
        self,
        images: Sequence[Path],
        validation: Sequence[Path],
        options: MatcherTrainingOptions,
        output: Path,
        places: Path | None = None,
        init_weights: str | Path | None = None,
        quiet: bool = True,
    ) -> None:
        self.options = options
        network: Any = (
            seeded(Matcher, options.seed)
            if init_weights is None
            else load_network(init_weights, Matcher)
        )
        self.network = network.train()
        self.origin = {
            **digests(images, validation),
            "initial_weights": weights_digest(self.network)[:16],
            "places": "" if places is None else key(files_of_places(places))[:16],
        }
        # Pairs of other images or places have another folder.
        folder = output / "pairs" / key([*self.origin.values()])[:12]
        self._draw = partial(draw_pairs, folder=folder, quiet=quiet)
        self._images, self._validation, self._places = images, validation, places
        self.average = copy.deepcopy(self.network).eval()
        reading = ("descriptor.", "adapted.", "traits.")
        named = [*self.network.named_parameters()]
        groups: list[dict[str, Any]] = [
            {"params": [p for n, p in named if n.startswith(reading)], "rate_factor": FIRST_FACTOR},
            {"params": [p for n, p in named if not n.startswith(reading)]},
        ]
        self.optimizers = [torch.optim.AdamW(groups, weight_decay=WEIGHT_DECAY)]
        self.steps = options.steps
        self.milestones = milestones(options.steps, options.val_count)
        self.notes = {"images": str(len(images))}

    @cached_property
    def files(self) -> list[Path]:
        """The training pairs, drawn when they are needed first."""
        options = self.options
        return self._draw(self._images, self._places, seed=options.seed + 2, count=options.drawn)

    @cached_property
    def held_out(self) -> list[tuple[dict[str, Tensor], Tensor, Tensor]]:
        """The validation pairs, drawn when they are needed first."""
        count = self.options.val_pairs
        files = self._draw(self._validation, None, seed=VALIDATION_SEED, count=count)
        return [as_tensors(read_pair(file)) for file in files]

    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches from step `first` on."""
        steps, dataset = range(first, self.steps), PairDataset(self.files, self.options)
        return DataLoader(dataset, batch_size=None, sampler=steps, generator=torch.Generator())

    def loss(self, batch: Sequence[tuple[dict[str, Tensor], Tensor, Tensor]]) -> Tensor:
        return torch.stack([loss_of(self.network, *pair)[0] for pair in batch]).mean()

    def learning_rate(self, step: int) -> float:
        """Return the learning rate of a step: a warm-up, a plateau, a linear decay to 0."""
        factor = with_plateau(step, self.steps, WARM_UP_STEPS, DECAY_SHARE)
        return self.options.learning_rate * factor

    def validate(self, step: int) -> dict[str, float]:
        """Measure the averaged weights on the validation pairs."""
        return measure(self.average, self.held_out)

    def export(self, folder: Path) -> Path:
        best: Any = load_network(folder / self.weights_file, Matcher)
        export_matcher(best, folder / ONNX)
        return folder / ONNX


@torch.no_grad()
def measure(
    network: Matcher, pairs: Sequence[tuple[dict[str, Tensor], Tensor, Tensor]]
) -> dict[str, float]:
    """Return the loss on pairs, and what is matched with a probability above MIN_PROBABILITY."""
    losses, right, counted, partnered, unrelated = [], 0, 0, 0, []
    for inputs, partners0, partners1 in pairs:
        loss, scores = loss_of(network, inputs, partners0, partners1)
        losses.append(loss.item())
        best, columns = scores.max(1)
        mutual = scores.argmax(0)[columns] == torch.arange(len(columns))
        rows = (mutual & (best > math.log(MIN_PROBABILITY))).nonzero()[:, 0]
        if not (partners0 >= 0).any():
            unrelated.append(len(rows))
            continue
        correct = partners0[rows] == columns[rows]
        known = (partners0[rows] != UNKNOWN) | (partners1[columns[rows]] != UNKNOWN)
        right += int(correct.sum())
        counted += int(known.sum())
        partnered += int((partners0 >= 0).sum())
    return {
        "validation_loss": float(np.mean(losses)),
        "matched": right / max(partnered, 1),
        "precision": right / max(counted, 1),
        "of_unrelated_views": float(np.mean(unrelated)) if unrelated else 0.0,
    }
