"""Train the network that tells right matches from wrong ones by their neighbours.

    python -m deepdetect_lab.training.match_filter photos/train photos/val match_filter.onnx

Keypoints of two views of a photograph, as `draw_layers` makes them, and now and then of unrelated
views, are described in one of two ways and matched; which matches are right is known. It takes a
quarter of an hour on two processors.
"""

from __future__ import annotations

import argparse
import math
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import binary_cross_entropy_with_logits, relu

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.errors import OptionError
from deepdetect._shared.machine import map_in_processes
from deepdetect._shared.progress import progress
from deepdetect.detector.point_detector import PointDetector
from deepdetect.features.keypoints import Keypoints
from deepdetect.features.learned import LEARNED, LEARNED_RATIO, RATIO, match_learned
from deepdetect.features.match_filter import AROUND, filter_inputs, nearest_rows
from deepdetect.features.matchers import DescriptorMatches, exact_neighbours, match_descriptors
from deepdetect.features.sift import ROOT_SIFT
from deepdetect.io.image import find_images

from ..evaluation.report import Table
from ..networks.export import OPSET
from .descriptor.task import ATTEMPTS
from .descriptor.views import correspond, draw_layers, relight, render_layers

WIDTH, ROUNDS = 32, 3
"""Numbers that describe a match, and how often those around it change them."""

OF_A_MATCH, OF_TWO = 4, 11
"""Numbers that the network begins with, of a match, and of one around another."""

SIDE_PX, KEYPOINTS, LEAST_MATCHES = 512, 2048, 9
"""Of the views, of each at most, and of a pair."""

UNRELATED = 7
"""One pair in this many shows two photographs; odd, so that both descriptors have some."""

RIGHT_PX, WRONG_PX = 3.0, 5.0
"""From the truth; what is between is neither."""

PAIRS, VALIDATION_PAIRS, STEPS, PAIRS_PER_STEP = 3600, 480, 2400, 8
"""Pairs of views, and the steps of the training, each of some of them, varied anew."""

LEARNING_RATE, WARM_UP_STEPS, DECAY_SHARE = 4e-3, 50, 0.7
WEIGHT_DECAY, MAX_GRADIENT_NORM = 0.01, 1.0
"""Of AdamW; the rate falls linearly to 0 in the last steps, this share of all."""

FEWEST_SHARE = 0.02
"""Of the matches of a pair, the fewest that are left, of half of the pairs."""

TURNED_SHARE = 0.3
"""Of the pairs, those that are turned as a whole."""

Sample = tuple[dict[str, np.ndarray], np.ndarray]
"""What the network is given, and each match's distance from the truth in pixels."""


class MatchFilter(nn.Module):
    """Maps matches, each with those around it, to the logits of their being right."""

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
        """Map (M, 2) pixels, (M,) sizes, turns in radians and ratios, (M, 2 K) rows of others."""
        growth, cosine, sine = (sizes1 / sizes0).log(), turns.cos(), turns.sin()
        distinct = 3 * ratios.clamp(0.05, 1.2).log() + 0.5
        own = torch.stack([distinct, growth, cosine - 0.7, sine], 1)
        pairs = self._compare(xy0, xy1, growth, cosine, sine, around)
        x = self.second(relu(self.first(own)))
        for k in range(ROUNDS):
            seen = self.of_two[k](pairs) + self.of_other[k](x)[around] + self.of_own[k](x)[:, None]
            seen = relu(self.message[k](relu(seen)))
            trust = self.trust[k](seen).sigmoid()
            mean = (seen * trust).sum(1) / (trust.sum(1) + 0.5)
            joined = self.joined[k](torch.cat([x, mean, seen.amax(1)], 1))
            x = self.norm[k](x + self.change[k](relu(joined)))
        return self.output(x)[:, 0]

    def _compare(
        self, xy0: Tensor, xy1: Tensor, growth: Tensor, cosine: Tensor, sine: Tensor, around: Tensor
    ) -> Tensor:
        """Return (M, 2 K, 11): how those around lie to a match, in units of their distance."""
        there0, there1 = xy0[around] - xy0[:, None], xy1[around] - xy1[:, None]
        away0, away1 = (each.square().sum(2).sqrt() for each in (there0, there1))
        middle = AROUND // 2
        unit = (away0[:, middle] * away1[:, AROUND + middle]).sqrt()[:, None, None] + 1
        # As the match's own size and angle would have it.
        (x, y), c, s = there0.unbind(2), cosine[:, None], sine[:, None]
        expected = torch.stack([c * x - s * y, s * x + c * y], 2) * growth.exp()[:, None, None]
        lengths = [there0, there1, 2 * (there1 - there0), 2 * (there1 - expected)]
        stretch = ((away1 + 1) / (away0 + 1)).log()
        growths = [stretch, growth[:, None] - stretch, growth[around] - growth[:, None]]
        scaled = torch.cat(lengths, 2) / unit
        # The inverse hyperbolic sine, which the exporter does not know.
        scaled = scaled.sign() * (scaled.abs() + (scaled * scaled + 1).sqrt()).log()
        return torch.cat([scaled, torch.stack(growths, 2)], 2)


def draw_sample(files: Sequence[Path], seed: int, number: int) -> Sample:
    """Draw a pair of views, described and matched, by a seed and the number of the pair."""
    rng = np.random.default_rng([seed, number])
    descriptor = (LEARNED, ROOT_SIFT)[number % 2]
    detector = PointDetector(KEYPOINTS, descriptor=descriptor)
    for _ in range(ATTEMPTS):
        layers, scales, _ = draw_layers(rng, files, SIDE_PX)
        views, tops = zip(*(render_layers(layers, k, scales[k]) for k in range(2)), strict=True)
        features0, features1 = (detector.extract(relight(rng, view / 255)) for view in views)
        related = number % UNRELATED > 0
        if not related:
            others, scales, _ = draw_layers(rng, files, SIDE_PX)
            view = render_layers(others, 0, scales[0])[0]
            features1 = detector.extract(relight(rng, view / 255))
        matches = mutual_matches(features0, features1)
        if len(matches) < LEAST_MATCHES:
            continue
        xy0, xy1 = features0.xy[matches.indices0], features1.xy[matches.indices1]
        errors = np.full(len(matches), np.inf, np.float32)
        if related:
            there, _, seen = correspond(layers, tops, xy0)
            errors[seen] = np.linalg.norm(there - xy1, axis=1)[seen]
            # What is mirrored at the border of a photograph may match rightly, or not.
            row, column = np.rint(xy0).astype(int).clip(0, SIDE_PX - 1).T[::-1]
            for k, layer in enumerate(layers):
                place = layer.views[0].to_photograph(xy0)
                last = np.array(layer.photograph.shape[1::-1]) - 1
                beyond = ~((place >= 0) & (place <= last)).all(1)
                errors[beyond & (tops[0][row, column] == k)] = (RIGHT_PX + WRONG_PX) / 2
        return filter_inputs(features0, features1, matches), errors
    raise OptionError("the images show too little for pairs of views: use photographs with detail")


def mutual_matches(features0: Keypoints, features1: Keypoints) -> DescriptorMatches:
    """Match by mutual nearest neighbours alone."""
    match = partial(match_descriptors, matcher=exact_neighbours, ratio=math.inf, mutual=True)
    if features0.descriptor_type == LEARNED:
        return match_learned(features0, features1, match)
    assert features0.descriptors is not None
    assert features1.descriptors is not None
    return match(features0.descriptors, features1.descriptors)


def vary(rng: np.random.Generator, sample: Sample) -> Sample:
    """Leave out matches, and mirror, turn and swap the images of a pair."""
    values, errors = sample
    values = {name: each for name, each in values.items() if name != "around"}
    if rng.random() < 0.5:
        count = max(LEAST_MATCHES, int(len(errors) * FEWEST_SHARE ** rng.random()))
        kept = np.sort(rng.permutation(len(errors))[:count])
        values, errors = {name: each[kept] for name, each in values.items()}, errors[kept]
    if rng.random() < 0.5:
        mirror = np.array([-1, 1], np.float32)
        values |= {"xy0": values["xy0"] * mirror, "xy1": values["xy1"] * mirror}
        values["turns"] = -values["turns"]
    if rng.random() < TURNED_SHARE:
        angle = rng.uniform(0, 2 * math.pi)
        c, s = math.cos(angle), math.sin(angle)
        turned = np.array([[c, s], [-s, c]], np.float32)
        values |= {"xy0": values["xy0"] @ turned, "xy1": values["xy1"] @ turned}
    if rng.random() < 0.5:
        for name in ("xy", "sizes"):
            first, second = f"{name}0", f"{name}1"
            values |= {first: values[second], second: values[first]}
        values["turns"] = -values["turns"]
    values["around"] = np.hstack([nearest_rows(values["xy0"]), nearest_rows(values["xy1"])])
    return values, errors


def join(samples: Sequence[Sample]) -> tuple[list[Tensor], Tensor]:
    """Make one of several pairs, whose matches are around none of another pair."""
    starts = np.cumsum([0, *(len(errors) for _, errors in samples[:-1])])
    moved = [
        {**values, "around": values["around"] + start}
        for (values, _), start in zip(samples, starts, strict=True)
    ]
    joined = [torch.from_numpy(np.concatenate([each[name] for each in moved])) for name in moved[0]]
    return joined, torch.from_numpy(np.concatenate([errors for _, errors in samples]))


def train(samples: Sequence[Sample], steps: int) -> MatchFilter:
    """Train on some pairs, in a random order."""
    torch.manual_seed(0)
    network, rng = MatchFilter(), np.random.default_rng(0)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=WEIGHT_DECAY)
    bar = progress(steps, "training", "step")
    for step in range(steps):
        rate = min(1, (step + 1) / WARM_UP_STEPS, (1 - step / steps) / DECAY_SHARE)
        optimizer.param_groups[0]["lr"] = LEARNING_RATE * rate
        rows = rng.integers(0, len(samples), PAIRS_PER_STEP)
        values, errors = join([vary(rng, samples[row]) for row in rows])
        known = (errors < RIGHT_PX) | (errors > WRONG_PX)
        right = (errors[known] < RIGHT_PX).float()
        loss = binary_cross_entropy_with_logits(network(*values)[known], right)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), MAX_GRADIENT_NORM)
        optimizer.step()
        bar.update()
    bar.close()
    return network.eval()


def draw_samples(files: Sequence[Path], seed: int, count: int) -> list[Sample]:
    """Draw pairs in all processors; each is a function of the seed and its number."""
    made = []
    with progress(count, "drawing pairs", "pair") as bar:
        for sample in map_in_processes(partial(draw_sample, files, seed), range(count)):
            made.append(sample)
            bar.update()
    return made


STYLES = {"descriptors": "", "matches kept": "", "right": ",d", "precision": ".3f"}
STYLES |= {"of unrelated views": ",d"}


@torch.no_grad()
def measure(network: MatchFilter, samples: Sequence[Sample]) -> Table:
    """Compare the ratio test, the filter, and the filter where it is as precise as that."""
    rows = []
    for offset, (name, limit) in enumerate(((LEARNED, LEARNED_RATIO), (ROOT_SIFT, RATIO))):
        numbers = range(offset, len(samples), 2)
        values, errors = join([samples[number] for number in numbers])
        logits, ratios = network(*values), values[[*samples[0][0]].index("ratios")]
        parts = [torch.full((len(samples[k][1]),), k % UNRELATED == 0) for k in numbers]
        unrelated = torch.cat(parts)
        right, known = errors < RIGHT_PX, (errors < RIGHT_PX) | (errors > WRONG_PX)
        by_ratio = ratios < limit
        precision = right[by_ratio & known].float().mean()
        order = logits[known].argsort(descending=True)
        share = right[known][order].cumsum(0) / torch.arange(1, len(order) + 1)
        reached = logits[known][order][share >= precision]
        lowest = reached[-1] if len(reached) else math.inf
        how = {f"ratio under {limit}": by_ratio, "filter": logits > 0}
        how["filter, as precise"] = logits >= lowest
        for title, kept in how.items():
            row = {"descriptors": name, "matches kept": title, "right": int(right[kept].sum())}
            row["precision"] = float(right[kept & known].float().mean())
            rows.append({**row, "of unrelated views": int((kept & unrelated).sum())})
    return Table("match_filter", "Matches of validation views", STYLES, rows)


def export(network: MatchFilter, sample: Sample, path: Path) -> None:
    """Write the network as `filter_matches` reads it."""
    names = list(sample[0])
    values = tuple(torch.from_numpy(each) for each in sample[0].values())
    axes = {name: {0: "matches"} for name in (*names, "logits")}
    how: dict[str, Any] = {"dynamo": False, "opset_version": OPSET, "dynamic_axes": axes}
    with atomic_path(path) as temporary, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what it traces
        torch.onnx.export(
            network, values, temporary, input_names=names, output_names=["logits"], **how
        )


def main() -> None:
    """Draw pairs, train, measure, and write the network."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("images", type=Path, help="folder of photographs")
    parser.add_argument("validation", type=Path, help="folder of others, for the measures")
    parser.add_argument("output", type=Path, help="ONNX file")
    arguments = parser.parse_args()
    samples = draw_samples(find_images(arguments.images), 0, PAIRS)
    network = train(samples, STEPS)
    validation = draw_samples(find_images(arguments.validation), 1, VALIDATION_PAIRS)
    print(measure(network, validation).to_markdown())
    export(network, validation[0], arguments.output)


if __name__ == "__main__":
    main()
