"""Training of the match filter, which separates correct and wrong matches by their neighbours.

A sample is a pair of views of one synthetic scene, or sometimes of two unrelated scenes. Keypoints
are matched by learned descriptors or RootSIFT. The scene tells which matches are correct.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, relu
from torch.utils.data import DataLoader, Dataset

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.machine import map_in_processes
from deepdetect._shared.progress import progress
from deepdetect.detector.point_detector import PointDetector
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.learned import LEARNED, match_learned, ratio_limit
from deepdetect.features.match_filter import AROUND, filter_inputs, nearest_rows
from deepdetect.features.matchers import DescriptorMatches, exact_neighbours, match_descriptors
from deepdetect.features.sift import ROOT_SIFT

from ..networks.export import to_onnx
from ..networks.weights import load_network
from .descriptor.views import photograph_view
from .recipe import MatchFilterTrainingOptions
from .sampler import milestones
from .scenes import correspond, draw_layers, draw_until_seen, render_layers
from .synthetic import rotation
from .trainer import Trainer, digests, seeded, with_plateau

ONNX = "match_filter.onnx"

WIDTH, ROUNDS = 32, 3
"""The network has `WIDTH` hidden features for each match, and `ROUNDS` rounds of message passing
between neighbouring matches. Both are chosen by hand."""

OF_A_MATCH, OF_TWO = 4, 11
"""Numbers of input features: `OF_A_MATCH` for a match, `OF_TWO` for a match and a neighbour."""

RATIO_RANGE, RATIO_SCALE, RATIO_OFFSET = (0.05, 1.2), 3, 0.5
"""The distance ratio of a match, as in the ratio test, is clipped to `RATIO_RANGE`. The feature
`RATIO_SCALE` * log(ratio) + `RATIO_OFFSET` has mean 0 and standard deviation 1, approximately."""

MEAN_COSINE = 0.7
"""Approximate mean of an input feature, the cosine of the rotation between matched keypoints. It is
subtracted from the feature, so that the mean becomes about 0."""

LEAST_TRUST = 0.5
"""The weighted sum of the neighbours' messages is divided by the sum of the weights plus this
number. So the result is near 0 if all weights are near 0. Chosen by hand."""

SIDE_PX, KEYPOINTS, LEAST_MATCHES = 512, 2048, 9
"""Side of the square views in pixels, their largest number of keypoints (both chosen by hand), and
the least number of matches of a pair: one more than a match has neighbours in an image."""

UNRELATED = 7
"""Every 7th pair shows two unrelated scenes. Pairs alternate between the two descriptors. The
number is odd, so that unrelated pairs occur with each descriptor. Chosen by hand."""

RIGHT_PX, WRONG_PX = 3.0, 5.0
"""A match with an error below `RIGHT_PX` is correct. A match with an error above `WRONG_PX` is
wrong. Matches in between are ignored, because the ground truth has errors of a pixel or two."""

WARM_UP_STEPS, DECAY_SHARE = 50, 0.7
"""The learning rate rises over the first `WARM_UP_STEPS` steps. Over the last share `DECAY_SHARE`
of the steps it falls linearly to 0. Chosen by hand."""

WEIGHT_DECAY = 0.01
"""Weight decay of AdamW, the default of torch."""

LEFT_OUT_SHARE, FEWEST_SHARE = 0.5, 0.02
"""Matches are left out at random in the share `LEFT_OUT_SHARE` of the pairs. At least the share
`FEWEST_SHARE` of the matches stays: only 2 %, because the filter is for pairs with few matches."""

TURNED_SHARE = 0.3
"""Share of the pairs in which both images are rotated by the same random angle. Chosen by hand."""

VALIDATION_SEED = 1
"""Seed of the validation pairs. It is the same for all seeds of the training."""

Sample = tuple[dict[str, np.ndarray], np.ndarray]
"""One pair of views: the inputs of the network by name, and the error of each match in pixels."""


class MatchFilter(nn.Module):
    """A network that returns a logit for each match, positive if the match is likely correct."""

    def __init__(self) -> None:
        super().__init__()

        def layers(inputs: int, outputs: int = WIDTH) -> nn.ModuleList:
            return nn.ModuleList(nn.Linear(inputs, outputs) for _ in range(ROUNDS))

        self.first, self.second = nn.Linear(OF_A_MATCH, WIDTH), nn.Linear(WIDTH, WIDTH)
        self.of_two, self.of_other, self.of_own = layers(OF_TWO), layers(WIDTH), layers(WIDTH)
        self.message, self.trust = layers(WIDTH), layers(WIDTH, 1)
        self.joined, self.change = layers(3 * WIDTH), layers(WIDTH)
        self.norm = nn.ModuleList(nn.LayerNorm(WIDTH) for _ in range(ROUNDS))
        self.output = nn.Linear(WIDTH, 1)

    def forward(
        self,
        xy0: Tensor,
        xy1: Tensor,
        sizes0: Tensor,
        sizes1: Tensor,
        turns: Tensor,
        ratios: Tensor,
        around: Tensor,
    ) -> Tensor:
        """Return the logits (M,) of matches, positive if a match is more likely correct than wrong.

        `xy0`, `xy1` (M, 2) and `sizes0`, `sizes1` (M,) are positions and sizes of the matched
        keypoints in pixels. `turns` (M,) are the rotations between them in radians, `ratios` (M,)
        the distance ratios. `around` (M, 2 K) holds the rows of each match's K nearest matches in
        each image.
        """
        growth, cosine, sine = (sizes1 / sizes0).log(), turns.cos(), turns.sin()
        distinct = RATIO_SCALE * ratios.clamp(*RATIO_RANGE).log() + RATIO_OFFSET
        own = torch.stack([distinct, growth, cosine - MEAN_COSINE, sine], 1)
        pairs = self._compare(xy0, xy1, growth, cosine, sine, around)
        x = self.second(relu(self.first(own)))
        for k in range(ROUNDS):
            seen = self.of_two[k](pairs) + self.of_other[k](x)[around] + self.of_own[k](x)[:, None]
            seen = relu(self.message[k](relu(seen)))
            trust = self.trust[k](seen).sigmoid()
            mean = (seen * trust).sum(1) / (trust.sum(1) + LEAST_TRUST)
            joined = self.joined[k](torch.cat([x, mean, seen.amax(1)], 1))
            x = self.norm[k](x + self.change[k](relu(joined)))
        return self.output(x)[:, 0]

    def _compare(
        self, xy0: Tensor, xy1: Tensor, growth: Tensor, cosine: Tensor, sine: Tensor, around: Tensor
    ) -> Tensor:
        """Return (M, 2 K, 11) features of each match relative to its K neighbours in each image.

        The first eight are x and y of four vectors: the offset to the neighbour in each image, the
        difference of both offsets, and the second offset minus the one that the match predicts.
        They are in units of the typical distance of neighbours, and large values are compressed.
        The last three features are logarithms of scale changes.
        """
        there0, there1 = xy0[around] - xy0[:, None], xy1[around] - xy1[:, None]
        away0, away1 = (each.square().sum(2).sqrt() for each in (there0, there1))
        middle = AROUND // 2
        unit = (away0[:, middle] * away1[:, AROUND + middle]).sqrt()[:, None, None] + 1
        # The offsets in the second image that a match's own size change and rotation predict.
        (x, y), c, s = there0.unbind(2), cosine[:, None], sine[:, None]
        expected = torch.stack([c * x - s * y, s * x + c * y], 2) * growth.exp()[:, None, None]
        lengths = [there0, there1, 2 * (there1 - there0), 2 * (there1 - expected)]
        stretch = ((away1 + 1) / (away0 + 1)).log()
        growths = [stretch, growth[:, None] - stretch, growth[around] - growth[:, None]]
        scaled = torch.cat(lengths, 2) / unit
        # This is the inverse hyperbolic sine, written out because the ONNX exporter lacks it.
        scaled = scaled.sign() * (scaled.abs() + (scaled * scaled + 1).sqrt()).log()
        return torch.cat([scaled, torch.stack(growths, 2)], 2)


def draw_sample(files: Sequence[Path], seed: int, number: int) -> Sample:
    """Draw a pair of views, and match their keypoints; return the matches as a `Sample`."""
    rng = np.random.default_rng([seed, number])
    detector = PointDetector(KEYPOINTS, descriptor=(LEARNED, ROOT_SIFT)[number % 2])

    def draw() -> Sample | None:
        layers, scales, _ = draw_layers(rng, files, SIDE_PX)
        views, tops = zip(*(render_layers(layers, k, scales[k]) for k in range(2)), strict=True)
        features0, features1 = (detector.extract(photograph_view(rng, v / 255)) for v in views)
        if number % UNRELATED == 0:
            others, scales, _ = draw_layers(rng, files, SIDE_PX)
            view = render_layers(others, 0, scales[0])[0]
            features1 = detector.extract(photograph_view(rng, view / 255))
        matches = mutual_matches(features0, features1)
        if len(matches) < LEAST_MATCHES:
            return None
        xy0, xy1 = features0.xy[matches.indices0], features1.xy[matches.indices1]
        errors = np.full(len(matches), np.inf, np.float32)
        if number % UNRELATED:
            there, _, seen = correspond(layers, tops, xy0)
            errors[seen] = np.linalg.norm(there - xy1, axis=1)[seen]
            # Views show the photograph mirrored beyond its border. Matches in a mirrored area may
            # be correct or wrong, so they get an error between the limits, which is ignored.
            row, column = np.rint(xy0).astype(int).clip(0, SIDE_PX - 1).T[::-1]
            for k, layer in enumerate(layers):
                place = layer.views[0].to_photograph(xy0)
                last = np.array(layer.photograph.shape[1::-1]) - 1
                beyond = ~((place >= 0) & (place <= last)).all(1)
                errors[beyond & (tops[0][row, column] == k)] = (RIGHT_PX + WRONG_PX) / 2
        return filter_inputs(features0, features1, matches), errors

    return draw_until_seen(draw)


def draw_samples(files: Sequence[Path], seed: int, count: int, quiet: bool = True) -> list[Sample]:
    """Draw pairs of views in parallel. The files, the seed and its number determine a pair."""
    made = []
    with progress(count, "drawing pairs", "pair", quiet) as bar:
        for sample in map_in_processes(partial(draw_sample, files, seed), range(count)):
            made.append(sample)
            bar.update()
    return made


def mutual_matches(features0: Keypoints, features1: Keypoints) -> DescriptorMatches:
    """Match descriptors by mutual nearest neighbours, without a ratio test."""
    match = partial(match_descriptors, matcher=exact_neighbours, ratio=math.inf, mutual=True)
    if features0.descriptor_type == LEARNED:
        return match_learned(features0, features1, match)[0]
    assert features0.descriptors is not None
    assert features1.descriptors is not None
    return match(features0.descriptors, features1.descriptors)


def vary(rng: np.random.Generator, sample: Sample) -> Sample:
    """Randomly leave out matches of a pair, and mirror, rotate and swap its images."""
    values, errors = sample
    values = {name: each for name, each in values.items() if name != "around"}
    if rng.random() < LEFT_OUT_SHARE:
        count = max(LEAST_MATCHES, int(len(errors) * FEWEST_SHARE ** rng.random()))
        kept = np.sort(rng.permutation(len(errors))[:count])
        values, errors = {name: each[kept] for name, each in values.items()}, errors[kept]
    if rng.random() < 0.5:
        mirror = np.array([-1, 1], np.float32)
        values |= {"xy0": values["xy0"] * mirror, "xy1": values["xy1"] * mirror}
        values["turns"] = -values["turns"]
    if rng.random() < TURNED_SHARE:
        turned = rotation(rng.uniform(0, 2 * math.pi)).T.astype(np.float32)
        values |= {"xy0": values["xy0"] @ turned, "xy1": values["xy1"] @ turned}
    if rng.random() < 0.5:
        for name in ("xy", "sizes"):
            first, second = f"{name}0", f"{name}1"
            values |= {first: values[second], second: values[first]}
        values["turns"] = -values["turns"]
    values["around"] = np.hstack([nearest_rows(values["xy0"]), nearest_rows(values["xy1"])])
    return values, errors


def join(samples: Sequence[Sample]) -> tuple[list[Tensor], Tensor]:
    """Concatenate several pairs into one batch. Matches of different pairs are not neighbours."""
    starts = np.cumsum([0, *(len(errors) for _, errors in samples[:-1])])
    moved = [
        {**values, "around": values["around"] + start}
        for (values, _), start in zip(samples, starts, strict=True)
    ]
    joined = [torch.from_numpy(np.concatenate([each[name] for each in moved])) for name in moved[0]]
    return joined, torch.from_numpy(np.concatenate([errors for _, errors in samples]))


def known(errors: Tensor) -> Tensor:
    """Return a mask of the matches that are clearly correct or wrong, by their errors in pixels."""
    return (errors < RIGHT_PX) | (errors > WRONG_PX)


class BatchDataset(Dataset[tuple[list[Tensor], Tensor]]):
    """The batch of each step: random pairs, randomly varied. The seed and the step determine it."""

    def __init__(self, samples: Sequence[Sample], options: MatchFilterTrainingOptions) -> None:
        self.samples, self.options = samples, options

    def __getitem__(self, step: int) -> tuple[list[Tensor], Tensor]:
        rng = np.random.default_rng([self.options.seed, 3, step])
        rows = rng.integers(0, len(self.samples), self.options.pairs)
        return join([vary(rng, self.samples[row]) for row in rows])


class MatchFilterTrainer(Trainer):
    """Training of the match filter on pairs of synthetic views of images."""

    objective, sign = "validation_loss", 1
    purpose = "that separates correct matches from wrong ones"
    measures = (
        "On pairs of views of the validation images: the cross-entropy, and measures of the "
        "matches that are kept by a ratio test, by the filter, and by the filter at the threshold "
        "where it is as precise as the ratio test. The measures are the number of correct matches, "
        "the precision, and the number of matches that are kept between unrelated views"
    )
    weights_file = "match_filter.safetensors"
    max_gradient_norm = 1.0
    average_decay = 0.0
    network: MatchFilter
    average: MatchFilter

    def __init__(
        self,
        images: Sequence[Path],
        validation: Sequence[Path],
        options: MatchFilterTrainingOptions,
        quiet: bool = True,
    ) -> None:
        self.options = options
        self.samples = draw_samples(images, options.seed, options.drawn, quiet)
        self.held_out = draw_samples(validation, VALIDATION_SEED, options.val_pairs, quiet)
        self.network = seeded(MatchFilter, options.seed)
        self.average = copy.deepcopy(self.network).eval()
        parameters = self.network.parameters()
        self.optimizers = [torch.optim.AdamW(parameters, weight_decay=WEIGHT_DECAY)]
        self.steps = options.steps
        self.milestones = milestones(options.steps, options.val_count)
        self.origin = digests(images, validation)
        self.notes = {"images": str(len(images))}

    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches from step `first` on, as returned by `join`."""
        steps, dataset = range(first, self.steps), BatchDataset(self.samples, self.options)
        return DataLoader(dataset, batch_size=None, sampler=steps, generator=torch.Generator())

    def loss(self, batch: tuple[list[Tensor], Tensor]) -> Tensor:
        values, errors = batch
        counted = known(errors)
        right = (errors[counted] < RIGHT_PX).float()
        return binary_cross_entropy_with_logits(self.network(*values)[counted], right)

    def learning_rate(self, step: int) -> float:
        """Return the learning rate of a step: a warm-up, a plateau, a linear decay to 0."""
        factor = with_plateau(step, self.steps, WARM_UP_STEPS, DECAY_SHARE)
        return self.options.learning_rate * factor

    def validate(self, step: int) -> dict[str, float]:
        """Measure the current weights on the validation pairs."""
        return measure(self.average, self.held_out)

    def export(self, folder: Path) -> Path:
        best: Any = load_network(folder / self.weights_file, MatchFilter)
        export_match_filter(best, self.held_out[0], folder / ONNX)
        return folder / ONNX


WAYS = ("ratio test", "filter", "filter, as precise")
MEASURES = ("right", "precision", "of unrelated views")


@torch.no_grad()
def measure(network: MatchFilter, samples: Sequence[Sample]) -> dict[str, float]:
    """Return the loss on validation pairs, and measures of the ratio test and of the filter.

    The filter is measured at the logit threshold 0, and at the one that gives it the precision of
    the ratio test.
    """
    found, losses = {}, []
    for offset, name in enumerate((LEARNED, ROOT_SIFT)):
        own = samples[offset::2]
        parts = [join([sample]) for sample in own]
        logits = torch.cat([network(*values) for values, _ in parts])
        errors = torch.cat([errors for _, errors in parts])
        ratios = torch.from_numpy(np.concatenate([values["ratios"] for values, _ in own]))
        counts = torch.tensor([len(errors) for _, errors in own])
        numbers = torch.arange(offset, len(samples), 2).repeat_interleave(counts)
        unrelated, counted, right = numbers % UNRELATED == 0, known(errors), errors < RIGHT_PX
        losses.append((logits[counted], right[counted].float()))
        by_ratio = ratios < ratio_limit(name)
        precision = right[by_ratio & counted].float().mean()
        order = logits[counted].argsort(descending=True)
        share = right[counted][order].cumsum(0) / torch.arange(1, len(order) + 1)
        reached = logits[counted][order][share >= precision]
        lowest = reached[-1] if len(reached) else math.inf
        for way, kept in zip(WAYS, (by_ratio, logits > 0, logits >= lowest), strict=True):
            values = (
                right[kept].sum(),
                right[kept & counted].float().mean(),
                (kept & unrelated).sum(),
            )
            for title, value in zip(MEASURES, values, strict=True):
                found[f"{name}, {way}: {title}"] = value.item()
    found_logits, truth = (torch.cat(each) for each in zip(*losses, strict=True))
    loss = binary_cross_entropy_with_logits(found_logits, truth)
    return {"validation_loss": loss.item(), **found}


def export_match_filter(network: MatchFilter, sample: Sample, path: Path) -> None:
    """Write the network as an ONNX file, which `filter_matches` reads."""
    inputs = {name: torch.from_numpy(each) for name, each in sample[0].items()}
    axes = {name: {0: "matches"} for name in (*inputs, "logits")}
    with atomic_path(path) as temporary:
        onnx.save(to_onnx(network, inputs, ("logits",), axes), temporary)
