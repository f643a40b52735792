"""Training of the learned descriptor: pairs of views, their loss, and the validation metric."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from ...networks.weights import load_network, weights_digest
from ..optim import Muon
from ..recipe import DescriptorTrainingOptions, DeviceOptions
from ..sampler import milestones
from ..scenes import draw_until_seen
from ..trainer import Trainer, digests, seeded, with_plateau
from .export import export_descriptor
from .losses import KINDS, contrastive_loss, kind_of, shares_right
from .network import DescriptorNetwork, KeypointNetwork
from .views import Pair, draw_pair

ONNX = "descriptor.onnx"

REUSE, WINDOW, FIRST_BATCHES = 4, 4096, 8
"""Each pair is used in `REUSE` steps on average, because drawing a pair takes longer than training
on it. Steps choose at random from the last `WINDOW` pairs drawn. About `FIRST_BATCHES` batches of
pairs are drawn for the first step. Chosen by hand."""

WARM_UP_STEPS, WARM_UP_SHARE = 300, 0.15
"""The learning rate rises over `WARM_UP_STEPS` steps, but at most over the share `WARM_UP_SHARE` of
all steps. Both are chosen by hand and not measured."""

DECAY_SHARE = 0.65
"""The learning rate falls linearly to 0 over this last share of the steps. Chosen by hand."""

VECTOR_RATE = 0.4
"""Learning rate of AdamW, which trains parameters unsuited to Muon, divided by Muon's rate.
Chosen by hand."""


def pairs_of_step(options: DescriptorTrainingOptions, step: int) -> np.ndarray:
    """Return the numbers of the pairs for a step, drawn from a window of recent pairs."""
    last = (step + 1) * options.pairs // REUSE + FIRST_BATCHES * options.pairs
    generator = np.random.default_rng([options.seed, 4, step])
    return generator.integers(max(0, last - WINDOW), last, options.pairs)


def pairs_to_draw(
    options: DescriptorTrainingOptions, first: int, last: int
) -> Iterator[tuple[int, list[int]]]:
    """Yield each step from `first` on, with the numbers of its pairs that are not drawn yet."""
    drawn: set[int] = set()
    for step in range(first, last):
        wanted = set(pairs_of_step(options, step).tolist())
        yield step, sorted(wanted - drawn)
        drawn |= wanted


def draw_numbered(files: Sequence[Path], *seed: int) -> Pair:
    """Draw a pair from a seed; raise an OptionError if the images have too little detail."""
    generator = np.random.default_rng(seed)
    return draw_until_seen(lambda: draw_pair(generator, files))


def stack(pairs: Sequence[Pair]) -> Pair:
    """Stack pairs that hold arrays into one batch that holds tensors."""
    return Pair(*(torch.from_numpy(np.stack(values)) for values in zip(*pairs, strict=True)))


class PairDataset(Dataset[tuple[int, list[int], Pair | None]]):
    """Each step, with the pairs that it is the first to use (or None) and their numbers.

    A pair is determined by the seed and the pair's number.
    """

    def __init__(self, files: Sequence[Path], options: DescriptorTrainingOptions) -> None:
        self.files, self.options = files, options

    def __getitem__(self, index: tuple[int, list[int]]) -> tuple[int, list[int], Pair | None]:
        step, numbers = index
        pairs = [draw_numbered(self.files, self.options.seed, 3, number) for number in numbers]
        return step, numbers, stack(pairs) if pairs else None


def validation_batches(files: Sequence[Path], options: DescriptorTrainingOptions) -> list[Pair]:
    """Draw the batches of validation pairs, `val_pairs` of each of `KINDS`, from a fixed seed."""
    pairs: dict[str, list[Pair]] = {kind: [] for kind in KINDS}
    number = 0
    while min(map(len, pairs.values())) < options.val_pairs:
        pair = draw_numbered(files, 0, 2, number)
        number += 1
        if len(of_kind := pairs[kind_of(pair.turn, pair.zoom)]) < options.val_pairs:
            of_kind.append(pair)
    drawn = [pair for of_kind in pairs.values() for pair in of_kind]
    return [stack(drawn[k : k + options.pairs]) for k in range(0, len(drawn), options.pairs)]


class DescriptorTrainer(Trainer):
    """Training of the descriptor network on pairs of synthetic views of images."""

    objective, sign = "score", -1
    purpose = "that describes keypoints"
    measures = (
        "Share of the keypoints whose match, a mutual nearest neighbour, is correct within 3 px, "
        "for each kind of pairs of views of the validation images; the score is the mean of these "
        "shares"
    )
    weights_file = "descriptor.safetensors"
    kind_of_network: type[KeypointNetwork] = DescriptorNetwork
    no_kernels: tuple[str, ...] = ("at_half", "by_size")
    max_gradient_norm = 2.0
    average_decay = 0.998
    decay_share = DECAY_SHARE
    network: KeypointNetwork
    average: KeypointNetwork
    window: Pair | None = None

    def __init__(
        self,
        images: Sequence[Path],
        validation: Sequence[Path],
        options: DescriptorTrainingOptions,
        init_weights: str | Path | None,
        device: DeviceOptions,
    ) -> None:
        self.options, self.num_workers = options, device.worker_count
        self.device = torch.device(device.accelerator)
        self.files = images
        network: Any = self.first_network(init_weights)
        self.origin = digests(images, validation)
        self.origin["initial_weights"] = weights_digest(network)[:16]
        self.notes = {"images": str(len(self.files)), "run_on": str(self.device)}
        batches = validation_batches(validation, options)
        self.batches = [Pair(*(each.to(self.device) for each in batch)) for batch in batches]
        self.network = network.to(self.device).to(memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.network).eval()
        self.network.train()
        # Muon suits layers between many features. AdamW trains the other parameters: the first
        # layer, the layers that take the keypoint's size or have few outputs, and vectors.
        groups: dict[tuple[bool, float], list[Any]] = {}
        for name, parameter in self.network.named_parameters():
            kernel = parameter.ndim > 1 and not name.startswith(self.no_kernels)
            groups.setdefault((kernel, self.rate_factor(name)), []).append(parameter)
        kernels, vectors = (
            [
                {"params": parameters, "rate_factor": factor * rate}
                for (kernel, factor), parameters in groups.items()
                if kernel == wanted
            ]
            for wanted, rate in ((True, 1.0), (False, VECTOR_RATE))
        )
        adam = torch.optim.AdamW(vectors, betas=(0.9, 0.98), weight_decay=0, fused=True)
        self.optimizers = [Muon(kernels), adam]
        self.steps = options.steps
        self.milestones = milestones(options.steps, options.val_count)

    def first_network(self, init_weights: str | Path | None) -> nn.Module:
        """Return the network before the first step: random, or with given weights."""
        if init_weights is None:
            return seeded(self.kind_of_network, self.options.seed)
        return load_network(init_weights, self.kind_of_network)

    def rate_factor(self, name: str) -> float:
        """Return the factor of the learning rate for the parameter with this name."""
        return 1.0

    def dataset(self) -> Dataset[Any]:
        """Return a dataset of batches, indexed by the items of `pairs_to_draw`."""
        return PairDataset(self.files, self.options)

    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches from step `first` on."""
        to_draw = pairs_to_draw(self.options, first, self.steps)
        return DataLoader(
            self.dataset(),
            batch_size=None,
            sampler=list(to_draw),
            num_workers=self.num_workers,
            generator=torch.Generator(),
        )

    def loss(self, batch: tuple[int, list[int], Pair | None]) -> Tensor:
        """Return the loss of the pairs that a step trains on.

        `batch` holds the number of the step and its new pairs. These replace the oldest pairs in
        `window`, a buffer on the device, which already holds the other pairs of the step.
        """
        step, numbers, pairs = batch
        if pairs is not None:
            pairs = Pair(*(values.to(self.device) for values in pairs))
            if self.window is None:
                self.window = Pair(*(each.new_zeros(WINDOW, *each.shape[1:]) for each in pairs))
            slots = torch.tensor(numbers, device=self.device) % WINDOW
            for kept, values in zip(self.window, pairs, strict=True):
                kept[slots] = values
        rows = torch.from_numpy(pairs_of_step(self.options, step) % WINDOW).to(self.device)
        chosen = Pair(*(kept[rows] for kept in self.window or ()))
        return self.loss_of_pairs(chosen, np.random.default_rng([self.options.seed, 5, step]))

    def loss_of_pairs(self, pairs: Pair, generator: np.random.Generator) -> Tensor:
        """Return the loss of the pairs of a step."""
        return contrastive_loss(self.network, pairs, generator)

    def learning_rate(self, step: int) -> float:
        """Return Muon's learning rate in a step: a warm-up, a plateau, a linear decay to 0."""
        warm_up = min(WARM_UP_STEPS, WARM_UP_SHARE * self.steps)
        return self.options.learning_rate * with_plateau(
            step, self.steps, warm_up, self.decay_share
        )

    def validate(self, step: int) -> dict[str, float]:
        """Measure the averaged weights on the validation pairs."""
        shares = shares_right(self.average, self.batches)
        return {"score": sum(shares.values()) / len(shares), **shares}

    def export(self, folder: Path) -> Path | None:
        best: Any = load_network(folder / self.weights_file, self.kind_of_network)
        export_descriptor(best, folder / ONNX)
        return folder / ONNX
