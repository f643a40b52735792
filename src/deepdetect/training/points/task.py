"""The training of the ranker: pairs of views, the loss of their order, the validation metric."""

from __future__ import annotations

import copy
import dataclasses
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Sampler

from ..._shared.errors import OptionError
from ..._shared.records import key, plain
from ...detector.points.ranker import load_ranker, notes_of
from ...io.image import find_images
from ..checkpoint import Point
from ..model_card import table
from ..recipe import PointsTrainingOptions
from ..trainer import Task
from .losses import pair_loss
from .measure import BUDGETS, RADII_PX, ValidationMetric, measure, points_detector, validation_pairs
from .model import RankerModule, save_ranker
from .pairs import PairDataset, PairIndex, PairSample
from .views import KINDS

STATISTICS_PAIRS = 64
"""Of views, whose features give mean and deviation."""

WARM_UP_STEPS = 100
FINAL_RATE = 0.02
"""Of the learning rate, at the end of the cosine annealing."""

WEIGHT_DECAY = 1e-4
MAX_GRADIENT_NORM = 1.0

AVERAGE_DECAY = 0.995
"""Of the running mean of the weights, which is what is measured and kept."""

MEASURES = [f"@{radius:g} px {budget}" for budget in BUDGETS for radius in RADII_PX] + ["correct"]
"""Columns of a kind: repeatability by budget and radius, and correct matches."""


class PairSampler(Sampler[list[PairIndex]]):
    """The batches of consecutive steps: pure functions of the step."""

    def __init__(self, pairs: int, first: int, last: int) -> None:
        self.pairs, self.steps = pairs, range(first, last)

    def __len__(self) -> int:
        return len(self.steps)

    def __iter__(self) -> Iterator[list[PairIndex]]:
        for step in self.steps:
            yield [PairIndex(step, position) for position in range(self.pairs)]


class RankerTask(Task):
    """A ranker of points, and the images whose views it is trained on.

    Args:
        images, validation: folders of images.
        options: the recipe.
        num_workers: processes that make pairs of views.

    Raises:
        ImageError: a folder is missing or empty.
    """

    columns = ("score", *(f"{kind} {name}" for kind in KINDS for name in MEASURES))
    objective, sign = "score", -1
    weights_file = "best.npz"

    def __init__(
        self, images: Path, validation: Path, options: PointsTrainingOptions, num_workers: int = 0
    ) -> None:
        self.options, self.num_workers = options, num_workers
        self.files = find_images(images)
        self.pairs = validation_pairs(validation, options.val_pairs)
        statistics = self._statistics()
        with torch.random.fork_rng(devices=()):  # the caller's random numbers are left alone
            torch.default_generator.manual_seed(options.seed)
            self.ranker = RankerModule(*statistics)
        self.average = copy.deepcopy(self.ranker).requires_grad_(False)
        self.network = torch.nn.ModuleDict({"ranker": self.ranker, "average": self.average})
        self.optimizers = [
            torch.optim.AdamW(
                self.ranker.parameters(), options.learning_rate, weight_decay=WEIGHT_DECAY
            )
        ]
        self.steps = options.steps
        parts = range(options.val_count + 1)
        self.milestones = {round(options.steps * part / options.val_count) for part in parts}
        origin = {
            "images_digest": _digest(self.files, images),
            "validation_digest": _digest(find_images(validation), validation),
        }
        self.inputs = {**plain(options), **origin}
        recipe = json.dumps(dataclasses.asdict(options), sort_keys=True)
        self.notes = {"options": recipe, "images": str(len(self.files)), **origin}

    def _statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and deviation of the features, over pairs that are not trained on."""
        dataset = PairDataset(self.files, self.options)
        samples = (dataset[PairIndex(2**31, number)] for number in range(STATISTICS_PAIRS))
        features = np.concatenate([side.features for each in samples for side in each.pair.sides])
        features = features.astype(np.float64)
        return features.mean(0), features.std(0)

    def loader(self, first: int = 0, last: int | None = None) -> DataLoader[Any]:
        """Return the loader of the batches of some steps: lists of `PairSample`."""
        return DataLoader(
            PairDataset(self.files, self.options),
            batch_sampler=PairSampler(
                self.options.pairs, first, self.steps if last is None else last
            ),
            collate_fn=list,
            num_workers=self.num_workers,
            generator=torch.Generator(),
        )

    def pixels(self, batch: Sequence[PairSample]) -> int:
        """Return the number of pixels in a batch."""
        return 2 * len(batch) * self.options.side**2

    def training_step(self, batch: Sequence[PairSample], step: int) -> float:
        """Make one optimiser step, and return the loss.

        Raises:
            OptionError: the loss or its gradients are not finite.
        """
        (optimizer,) = self.optimizers
        for group in optimizer.param_groups:
            group["lr"] = self.learning_rate(step)
        optimizer.zero_grad(set_to_none=True)
        loss = batch_loss(self.ranker, batch, self.options)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.ranker.parameters(), MAX_GRADIENT_NORM)
        if not (loss.isfinite() and norm.isfinite()):
            raise OptionError(
                f"the loss or its gradients are not finite at step {step}: lower `learning_rate`"
            )
        optimizer.step()
        # At first the mean follows faster, so that the start is soon forgotten.
        decay = min(AVERAGE_DECAY, (1 + step) / (10 + step))
        with torch.no_grad():
            weights = zip(self.average.parameters(), self.ranker.parameters(), strict=True)
            for mean, parameter in weights:
                mean.lerp_(parameter, 1 - decay)
        return float(loss.detach())

    def learning_rate(self, step: int) -> float:
        """Return the learning rate of a step: a linear warm-up into cosine annealing."""
        cosine = (1 + math.cos(math.pi * step / self.steps)) / 2
        rate = self.options.learning_rate * (FINAL_RATE + (1 - FINAL_RATE) * cosine)
        return rate * min(1.0, (step + 1) / WARM_UP_STEPS)

    def measure(self) -> ValidationMetric:
        """Measure the average of the weights so far."""
        return measure(points_detector(self.average.export({})), self.pairs)

    def validate(self, step: int) -> dict[str, float]:
        """Measure the average of the weights; by `columns`."""
        found = self.measure()
        values = [found.score]
        for kind in KINDS:
            values += [*found.repeatability[kind].ravel().tolist(), found.correct[kind]]
        return dict(zip(self.columns, values, strict=True))

    def save(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Write the average of the weights."""
        save_ranker(self.average.export(dict(notes)), path)

    def read_notes(self, path: Path) -> Mapping[str, Any]:
        """Read the notes of a whole ranker."""
        return notes_of(load_ranker(path))

    def card(self, best: Point) -> tuple[str, list[str]]:
        """Say in the model card what the ranker is, and how good it is."""
        count = sum(parameter.numel() for parameter in self.ranker.parameters())
        network = (
            f"a perceptron of {count:,} parameters that ranks maxima of |det Hessian| in a scale\n"
            "space by how surely they are found again."
        )
        rows = [[kind, *(f"{best[f'{kind} {m}']:.3f}" for m in MEASURES)] for kind in KINDS]
        return network, [
            "On synthetic pairs of views of the validation images, by whose score this step was",
            "chosen: one-to-one repeatability by number of keypoints (of an image of 800x640), and",
            "matches correct to 1 px over the number of keypoints.",
            "",
            *table(["pairs", *MEASURES], rows),
            "",
            f"Score {best['score']:.4f} at step {best['step']:,}.",
        ]


def _digest(files: Sequence[Path], folder: Path) -> str:
    """Return a digest of the names and sizes of files."""
    return key([(file.relative_to(folder).as_posix(), file.stat().st_size) for file in files])[:16]


def batch_loss(
    ranker: torch.nn.Module, samples: Sequence[PairSample], options: PointsTrainingOptions
) -> torch.Tensor:
    """Return the mean loss of some pairs of views; those with nothing to see are left out."""
    losses = [
        pair_loss(ranker, sample.pair, sample.density, options.match_weight)
        for sample in samples
        if min(len(side.xy) for side in sample.pair.sides) > 1
    ]
    if not losses:
        return torch.stack([p.sum() for p in ranker.parameters()]).sum() * 0
    return torch.stack(losses).sum() / len(samples)
