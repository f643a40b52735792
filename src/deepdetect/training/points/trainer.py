"""Training of the ranker: steps, checkpoints, and the hard measure that picks the best weights."""

from __future__ import annotations

import copy
import dataclasses
import hashlib
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

from ..._shared.errors import OptionError, WeightsError
from ..._shared.progress import progress
from ..._shared.provenance import provenance
from ...detector.points.ranker import load_ranker, notes_of
from ...io.image import find_images
from ..checkpoint import (
    check_steps,
    read_checkpoint,
    read_number,
    read_rows,
    restore,
    save_checkpoint,
)
from ..dataset import loading
from .dataset import PairDataset, PairIndex, PairSample, PairSampler
from .losses import pair_loss
from .measure import HardMeasure, measure, points_detector, validation_pairs
from .model import RankerModule, save_ranker
from .recipe import PointsTrainingOptions
from .report import MEASURES, save_curves, write_model_card
from .views import KINDS

CHECKPOINT = "checkpoint.safetensors"
BEST = "best.npz"
CARD = "MODEL_CARD.md"

STATISTICS_PAIRS = 64
"""Of views, whose features give mean and deviation."""


@dataclass
class PointsState:
    """How far a run has come.

    Attributes:
        step: optimiser steps done.
        loss_sum, loss_count: since the last measure.
        seconds: CPU seconds of the training alone.
        best_score: of the hard measure, so far.
        points: a row for each measure.
    """

    step: int = 0
    loss_sum: float = 0.0
    loss_count: int = 0
    seconds: float = 0.0
    best_score: float = -1.0
    points: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def from_json(cls, values: Mapping[str, Any], last_step: int) -> PointsState:
        """Read the state from a checkpoint's metadata.

        Raises:
            ValueError: a value is missing, of another type or out of its range.
        """
        step, loss_count = (read_number(values, name, int) for name in ("step", "loss_count"))
        if step > last_step:
            raise ValueError(f"step {step} lies behind the last one, {last_step}")
        rows = read_rows(values)
        for row in rows:
            _check_row(row)
        check_steps([row["step"] for row in rows], step)
        if not rows:
            raise ValueError("there are no points")
        return cls(
            step,
            read_number(values, "loss_sum", float),
            loss_count,
            read_number(values, "seconds", float),
            read_number(values, "best_score", float),
            rows,
        )


class PointsTrainer:
    """A run over a folder of photographs, measured on another.

    A run that was interrupted goes on from its last checkpoint, with the same result as one that
    was not.

    Args:
        photos, validation: folders of photographs.
        folder: of the run: checkpoint.safetensors, best.npz, curves.csv, curves.png, MODEL_CARD.md.
        options: the recipe.
        measure_every: steps from one hard measure to the next.
        save_every: steps from one checkpoint to the next.
        pairs_per_kind: of the hard measure.
        workers: processes that render views.
        quiet: show no progress bar and no measures.

    Raises:
        ImageError: a folder is missing or empty.
        OptionError: the folder holds a run with other options.
        WeightsError: its checkpoint is damaged.
    """

    def __init__(
        self,
        photos: Path,
        validation: Path,
        folder: Path,
        options: PointsTrainingOptions = PointsTrainingOptions(),
        *,
        measure_every: int = 500,
        save_every: int = 100,
        pairs_per_kind: int = 16,
        workers: int = 0,
        quiet: bool = True,
    ) -> None:
        self.options, self.folder, self.quiet = options, folder, quiet
        self.measure_every, self.save_every, self.workers = measure_every, save_every, workers
        if min(measure_every, save_every, pairs_per_kind) < 1 or workers < 0:
            raise OptionError(
                "measure_every, save_every and pairs_per_kind must be 1 or more, workers 0 or more"
            )
        self.files = find_images(photos)
        self.pairs = validation_pairs(validation, pairs_per_kind)
        statistics = self._statistics()
        with torch.random.fork_rng(devices=()):  # the caller's random numbers are left alone
            torch.default_generator.manual_seed(options.seed)
            self.ranker = RankerModule(*statistics, options.hidden)
        self.average = copy.deepcopy(self.ranker).requires_grad_(False)
        self.both = torch.nn.ModuleDict({"ranker": self.ranker, "average": self.average})
        self.optimizer = torch.optim.AdamW(
            self.ranker.parameters(), options.learning_rate, weight_decay=options.weight_decay
        )
        self.state = PointsState()
        self.run = {
            "options": options.to_json(),
            "photographs": len(self.files),
            "photographs_digest": _digest(self.files, photos),
            "validation_digest": _digest(find_images(validation), validation),
            "pairs_per_kind": pairs_per_kind,
            "measure_every": measure_every,
        }
        folder.mkdir(parents=True, exist_ok=True)
        self._resume()

    def fit(self, last_step: int | None = None, seconds: float = math.inf) -> PointsState:
        """Train to the last step of the recipe, or stop earlier, with a checkpoint.

        Args:
            last_step: stop when this many steps are done.
            seconds: stop after this time.
        """
        state = self.state
        end = self.options.steps if last_step is None else min(last_step, self.options.steps)
        started = time.monotonic()
        if not state.points:
            self._measure()
            self._save()
        if state.best_score < 0 and state.step == self.options.steps:
            self._keep(state.points[-1])  # they were damaged, and no further measure comes
            self._write_card()
        bar = progress(self.options.steps, "training", "step", self.quiet, state.step)
        with bar, loading(self._loader()) as batches:
            while state.step < end and time.monotonic() - started < seconds:
                before = time.process_time()
                value = self.training_step(next(batches))
                state.seconds += time.process_time() - before
                state.loss_sum += value
                state.loss_count += 1
                state.step += 1
                bar.update(1)
                measured = state.step % self.measure_every == 0 or state.step == self.options.steps
                if measured:
                    self._measure()
                if measured or state.step % self.save_every == 0:
                    self._save()
        self._save()
        return state

    def training_step(self, samples: Sequence[PairSample]) -> float:
        """Make one optimiser step, and return the loss.

        Raises:
            OptionError: the loss or its gradients are not finite.
        """
        options = self.options
        for group in self.optimizer.param_groups:
            group["lr"] = options.learning_rate_at(self.state.step)
        self.optimizer.zero_grad(set_to_none=True)
        loss = batch_loss(self.ranker, samples, options)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.ranker.parameters(), options.max_gradient_norm)
        if not (loss.isfinite() and norm.isfinite()):
            raise OptionError(
                f"the loss or its gradients are not finite at step {self.state.step}: "
                "lower `learning_rate`"
            )
        self.optimizer.step()
        self._update_average()
        return float(loss.detach())

    @torch.no_grad()
    def _update_average(self) -> None:
        """Follow the weights; at first faster, so that the start is soon forgotten."""
        decay = min(self.options.average_decay, (1 + self.state.step) / (10 + self.state.step))
        weights = zip(self.average.parameters(), self.ranker.parameters(), strict=True)
        for mean, parameter in weights:
            mean.lerp_(parameter, 1 - decay)

    def measure(self) -> HardMeasure:
        """Measure the average of the weights so far."""
        return measure(points_detector(self.average.export({})), self.pairs)

    def _statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and deviation of the features, over some pairs."""
        dataset = PairDataset(self.files, self.options)
        features = np.concatenate(
            [
                side.features
                for k in range(STATISTICS_PAIRS)
                for side in dataset[_early(k)].pair.sides
            ]
        ).astype(np.float64)
        return features.mean(0), features.std(0)

    def _loader(self) -> DataLoader[Any]:
        return DataLoader(
            PairDataset(self.files, self.options),
            batch_sampler=PairSampler(self.options, self.state.step),
            collate_fn=list,
            num_workers=self.workers,
            generator=torch.Generator(),
        )

    def _measure(self) -> None:
        found, state = self.measure(), self.state
        row: dict[str, Any] = {
            "step": state.step,
            "loss": state.loss_sum / max(state.loss_count, 1),
            "cpu_seconds": round(state.seconds, 1),
            "score": found.score,
            **{
                kind: [*value.ravel().tolist(), found.correct[kind]]
                for kind, value in found.repeatability.items()
            },
        }
        state.points.append(row)
        state.loss_sum, state.loss_count = 0.0, 0
        best = found.score > state.best_score
        if best:
            self._keep(row)
        self._write_card()
        save_curves(state.points, self.folder)
        mark = " *" if best else ""
        self._say(f"{state.step:6d} loss {row['loss']:+.4f} score {found.row()}{mark}")

    def _keep(self, row: dict[str, Any]) -> None:
        """Write the average of the weights as the best so far."""
        self.state.best_score = row["score"]
        point = {name: value for name, value in row.items() if name != "cpu_seconds"}
        notes = {**self.run, **provenance(), "point": point}
        save_ranker(self.average.export(notes), self.folder / BEST)

    def _is_best_whole(self) -> bool:
        """Return whether the best weights can be read, and are of this run."""
        try:
            notes: dict[str, Any] = notes_of(load_ranker(self.folder / BEST))
            _check_row({"cpu_seconds": 0, **notes["point"]})
        except (WeightsError, KeyError, TypeError, ValueError, AttributeError, RecursionError):
            return False
        return all(notes.get(name) == value for name, value in self.run.items())

    def _say(self, line: str) -> None:
        if not self.quiet:
            from tqdm import tqdm

            tqdm.write(line)

    def _write_card(self) -> None:
        best = self.folder / BEST
        if not best.exists():
            return
        ranker = load_ranker(best)
        count = sum(parameter.numel() for parameter in self.ranker.parameters())
        write_model_card(self.folder / CARD, best, count, notes_of(ranker), self.state.points)

    def _save(self) -> None:
        metadata = {**dataclasses.asdict(self.state), **self.run}
        save_checkpoint(self.folder / CHECKPOINT, self.both, [self.optimizer], metadata)

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT
        if not path.exists():
            return
        found = read_checkpoint(path)
        if any(found.metadata.get(name) != value for name, value in self.run.items()):
            raise OptionError(
                f"{self.folder} holds a run with other options: use the same ones to resume it, "
                "or another folder"
            )
        try:
            state = PointsState.from_json(found.metadata, self.options.steps)
        except ValueError as error:
            raise found.unfit(error) from None
        if state.step:
            restore(found, self.both, [self.optimizer])
        self.state = state
        if not self._is_best_whole():
            state.best_score = PointsState.best_score
            at_end = state.step == self.options.steps
            self._say(
                f"{self.folder / BEST} is missing or damaged: it is written again "
                f"{'with the last weights' if at_end else 'at the next measure'}"
            )


def _check_row(row: Any) -> None:
    """Raise a ValueError where a row of measures is not as `PointsTrainer` writes it."""
    if not isinstance(row, dict):
        raise ValueError("a point is not an object")
    read_number(row, "step", int)
    for name in ("loss", "cpu_seconds", "score"):
        read_number(row, name, float)
    for kind in KINDS:
        listed = row.get(kind)
        if not isinstance(listed, list) or len(listed) != len(MEASURES):
            raise ValueError(f"{kind} is not a list of {len(MEASURES)} numbers")
        for value in listed:
            read_number({kind: value}, kind, float)


def _digest(files: Sequence[Path], folder: Path) -> str:
    """Return a digest of the names and sizes of files."""
    lines = [f"{file.relative_to(folder).as_posix()} {file.stat().st_size}" for file in files]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _early(number: int) -> PairIndex:
    """Return an index before the first step: pairs that are not trained on."""
    return PairIndex(2**31, number)


def batch_loss(
    ranker: torch.nn.Module, samples: Sequence[PairSample], options: PointsTrainingOptions
) -> torch.Tensor:
    """Return the mean loss of some pairs of views; those with nothing to see are left out."""
    losses = [
        pair_loss(ranker, sample.pair, sample.density, options)
        for sample in samples
        if min(len(side.xy) for side in sample.pair.sides) > 1
    ]
    if not losses:
        return torch.stack([p.sum() for p in ranker.parameters()]).sum() * 0
    return torch.stack(losses).sum() / len(samples)
