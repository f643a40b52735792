"""Training of the learned descriptor on pairs of views, and on outputs of published networks."""

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
from ..teachers.readings import Whitening, reading_file
from ..trainer import Trainer, digests, seeded, with_plateau
from .crops import Crops, draw_crops
from .export import export_descriptor
from .losses import KINDS, contrastive_loss, kind_of, shares_right
from .network import BACKBONE, DescriptorNetwork
from .teaching import PAIR_WEIGHT, crop_losses, measure_teaching
from .views import Pair, draw_pair

ONNX = "descriptor.onnx"

REUSE, WINDOW, FIRST_BATCHES = 4, 4096, 8
"""Each pair is used in `REUSE` steps on average, because drawing a pair takes longer than training
on it. Steps choose at random from the last `WINDOW` pairs drawn. About `FIRST_BATCHES` batches of
pairs are drawn for the first step. Chosen by hand."""

WARM_UP_STEPS, WARM_UP_SHARE = 300, 0.15
"""The learning rate rises over `WARM_UP_STEPS` steps, but at most over the share `WARM_UP_SHARE` of
all steps. Both are chosen by hand and not measured."""

DECAY_SHARE = 0.82
"""The learning rate falls linearly to 0 over this last share of the steps. In a run from trained
weights, the measures on photos/val improved little in 1,300 steps at the highest rate, and more in
the next 1,000, while the rate fell to 0.87 of it."""

VECTOR_RATE = 0.4
"""Learning rate of AdamW, which trains parameters unsuited to Muon, divided by Muon's rate.
Chosen by hand."""

BACKBONE_RATE = 0.5
"""Factor of the learning rate of the layers that may start from EdgePoint2's weights, so that they
keep more of what EdgePoint2 learned from real pairs. Chosen by hand."""

NO_KERNELS = "at_half", "by_size", "score"
"""Name prefixes of the layers that Muon does not train."""

VAL_CROPS = 8
"""Number of validation batches of crops, each as large as a step's batch. Chosen by hand."""

TAUGHT_BY = (
    "It starts with layers of EdgePoint2-L64 (MIT, HITCSC-Robotics), and is taught by "
    "EdgePoint2-E64 (MIT, HITCSC-Robotics) and ALIKED-n16rot (BSD-3-Clause)"
)
TAUGHT_MEASURES = (
    "Share of keypoints whose mutual nearest neighbour is correct within 3 px, for the three "
    "kinds of pairs of views of the validation images; mean cosine of predicted codes to the "
    "whitened codes of both teachers; share of points whose predicted code is nearest to their "
    "own; correlation of scores with those of ALIKED; the score is the mean of the first five"
)

Batch = tuple[int, list[int], Pair | None, Crops | None]
"""The number of a step, the numbers of the pairs that it is the first to use, these pairs (or None)
and the step's crops."""


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


class BatchDataset(Dataset[Batch]):
    """The batch of each step. A pair is determined by the seed and the pair's number.

    Without `readings`, there are no crops.
    """

    def __init__(
        self, files: Sequence[Path], options: DescriptorTrainingOptions, readings: Path | None
    ) -> None:
        self.files, self.options, self.readings = files, options, readings

    def __getitem__(self, index: tuple[int, list[int]]) -> Batch:
        (step, numbers), options, crops = index, self.options, None
        pairs = [draw_numbered(self.files, options.seed, 3, number) for number in numbers]
        if self.readings is not None:
            generator = np.random.default_rng([options.seed, 6, step])
            crops = draw_crops(self.files, self.readings, options.crops, generator)
        return step, numbers, stack(pairs) if pairs else None, crops


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
    """Training of the descriptor network on pairs of synthetic views of images.

    With `readings`, it also learns the outputs of its teachers. If readings are still being written
    during a run, its result depends on the times of writing.
    """

    objective, sign = "score", -1
    purpose = "that describes keypoints"
    measures = (
        "Share of the keypoints whose match, a mutual nearest neighbour, is correct within 3 px, "
        "for each kind of pairs of views of the validation images; the score is the mean of these "
        "shares"
    )
    weights_file = "descriptor.safetensors"
    max_gradient_norm = 2.0
    average_decay = 0.998
    network: DescriptorNetwork
    average: DescriptorNetwork
    window: Pair | None = None

    def __init__(
        self,
        images: Sequence[Path],
        validation: Sequence[Path],
        options: DescriptorTrainingOptions,
        init_weights: str | Path | None,
        device: DeviceOptions,
        readings: Path | None = None,
    ) -> None:
        self.options, self.num_workers = options, device.worker_count
        self.device = torch.device(device.accelerator)
        self.files, self.readings = images, readings
        self.val_crops: list[Crops] = []
        if readings is not None:
            self.purpose, self.measures = f"{self.purpose}. {TAUGHT_BY}", TAUGHT_MEASURES
            read = [path for image in images if (path := reading_file(image, readings)).exists()]
            self.whiten = Whitening(read)
            rng = np.random.default_rng([options.seed, 7])
            drawn = (draw_crops(validation, readings, options.crops, rng) for _ in range(VAL_CROPS))
            self.val_crops = list(drawn)
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
        groups: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
        for name, parameter in self.network.named_parameters():
            kernel = parameter.ndim > 1 and not name.startswith(NO_KERNELS)
            rate = BACKBONE_RATE if name.startswith(BACKBONE) else 1.0
            factor = rate if kernel else VECTOR_RATE * rate
            groups[kernel].append({"params": [parameter], "rate_factor": factor})
        adam = torch.optim.AdamW(groups[False], betas=(0.9, 0.98), weight_decay=0, fused=True)
        self.optimizers = [Muon(groups[True]), adam]
        self.steps = options.steps
        self.milestones = milestones(options.steps, options.val_count)

    def first_network(self, init_weights: str | Path | None) -> nn.Module:
        """Return the network before the first step: random, or with weights from a file.

        A .pth file has the weights of EdgePoint2-L64, with which some of the layers start.
        """
        if init_weights is not None and Path(init_weights).suffix != ".pth":
            return load_network(init_weights, DescriptorNetwork)
        network = seeded(DescriptorNetwork, self.options.seed)
        if init_weights is not None:
            network.start_from(Path(init_weights))
        return network

    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches from step `first` on."""
        to_draw = pairs_to_draw(self.options, first, self.steps)
        return DataLoader(
            BatchDataset(self.files, self.options, self.readings),
            batch_size=None,
            sampler=list(to_draw),
            num_workers=self.num_workers,
            generator=torch.Generator(),
        )

    def loss(self, batch: Batch) -> Tensor:
        """Return the sum of the losses of a step's crops, if any, and of its pairs.

        The new pairs of the step replace the oldest pairs in `window`, a buffer on the device,
        which already holds the other pairs of the step.
        """
        step, numbers, pairs, crops = batch
        if pairs is not None:
            pairs = Pair(*(values.to(self.device) for values in pairs))
            if self.window is None:
                self.window = Pair(*(each.new_zeros(WINDOW, *each.shape[1:]) for each in pairs))
            slots = torch.tensor(numbers, device=self.device) % WINDOW
            for kept, values in zip(self.window, pairs, strict=True):
                kept[slots] = values
        losses = [] if crops is None else crop_losses(self.network, self.on_device(crops)).values()
        rows = torch.from_numpy(pairs_of_step(self.options, step) % WINDOW).to(self.device)
        chosen = Pair(*(kept[rows] for kept in self.window or ()))
        generator = np.random.default_rng([self.options.seed, 5, step])
        of_pairs = contrastive_loss(self.network, chosen, generator)
        return of_pairs if crops is None else sum(losses, PAIR_WEIGHT * of_pairs)

    def on_device(self, crops: Crops) -> Crops:
        """Return crops on the device, with whitened codes."""
        crops = Crops(*(values.to(self.device) for values in crops))
        return crops._replace(codes=self.whiten(crops.codes))

    def learning_rate(self, step: int) -> float:
        """Return Muon's learning rate in a step: a warm-up, a plateau, a linear decay to 0."""
        warm_up = min(WARM_UP_STEPS, WARM_UP_SHARE * self.steps)
        return self.options.learning_rate * with_plateau(step, self.steps, warm_up, DECAY_SHARE)

    def validate(self, step: int) -> dict[str, float]:
        """Measure the averaged weights on the validation pairs and crops."""
        measures = shares_right(self.average, self.batches)
        counted = list(measures)
        if self.val_crops:
            measures |= measure_teaching(self.average, map(self.on_device, self.val_crops))
            counted += ["teachers score", "teachers found"]
        return {"score": sum(measures[name] for name in counted) / len(counted), **measures}

    def export(self, folder: Path) -> Path | None:
        best: Any = load_network(folder / self.weights_file, DescriptorNetwork)
        export_descriptor(best, folder / ONNX)
        return folder / ONNX
