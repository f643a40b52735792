"""A training run of any network: steps, validations, files and resuming."""

from __future__ import annotations

import abc
import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torch.optim import Optimizer
from torch.utils.data import DataLoader

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.errors import OptionError
from deepdetect._shared.progress import progress
from deepdetect._shared.records import check_same, file_digest, key, plain

from ..evaluation.provenance import provenance
from ..evaluation.report import Table, line_chart
from ..networks.weights import read_notes, save_tensors
from .checkpoint import Point, read_checkpoint, restore, save_checkpoint
from .dataset import loading

Network = TypeVar("Network", bound=nn.Module)

CHECKPOINT = "checkpoint.safetensors"
CARD = "MODEL_CARD.md"

CHECKPOINT_INTERVAL_S = 60.0
"""Seconds between checkpoints: a killed run loses about this time at most. Chosen by hand."""


@dataclass
class TrainingState:
    """Progress of a run: the number of steps done, and the points of the training curves.

    `loss_sum` and `loss_count` are the sum and the number of batch losses since the last point.
    """

    step: int = 0
    loss_sum: float = 0.0
    loss_count: int = 0
    points: list[Point] = field(default_factory=list)


@dataclass(frozen=True)
class TrainingResult:
    """The results of a run.

    Attributes:
        weights: safetensors or npz file of the weights that are best in the validation.
        onnx: ONNX file with the same weights; None for a ranker.
        points: points of the training curves: losses and measures by name, for each validation.
        best: the point of the best weights.
    """

    weights: Path
    onnx: Path | None
    points: list[Point]
    best: Point


class Trainer(abc.ABC):
    """A training run; subclasses define the network, the loss and the validation.

    Attributes:
        network: the network that is trained.
        average: exponential moving average of the network's state, which is validated and saved.
        average_decay: decay of the average per step. With 0 the average equals the network.
        optimizers: the optimisers of the network's parameters.
        options: the recipe.
        origin: digests of the images and the initial weights. A run is resumed only with the same
            recipe and origin.
        notes: further notes to store in the weights file.
        purpose: what the network does, as a text for the model card.
        measures: what the validation measures, as a text for the model card.
        introduction: lines that are shown to the user before the first step.
        steps: number of steps of the whole run.
        milestones: numbers of steps after which the averaged network is validated.
        objective: name of the measure by which the best weights are chosen.
        sign: 1 if the lowest value of the measure is the best, -1 if the highest is.
        weights_file: name of the file of the best weights.
        max_gradient_norm: gradients with a larger norm are scaled down to it.
    """

    network: nn.Module
    average: nn.Module
    average_decay: float
    optimizers: list[Optimizer]
    options: Any
    origin: dict[str, str]
    notes: dict[str, str]
    purpose: str
    measures: str
    introduction: Sequence[str] = ()
    steps: int
    milestones: set[int]
    objective: str
    sign: int
    weights_file: str
    max_gradient_norm = math.inf

    @abc.abstractmethod
    def loader(self, first: int = 0) -> DataLoader[Any]:
        """Return a loader of the batches from step `first` to the last step."""

    @abc.abstractmethod
    def learning_rate(self, step: int) -> float:
        """Return the learning rate of a step."""

    @abc.abstractmethod
    def loss(self, batch: Any) -> Tensor:
        """Return the loss of a batch."""

    @abc.abstractmethod
    def validate(self, step: int) -> dict[str, float]:
        """Validate the weights after a number of steps; return the measures by name."""

    def save(self, path: Path, notes: Mapping[str, Any]) -> None:
        """Write the averaged weights to a file, with notes."""
        save_tensors(self.average.state_dict(), path, dict(notes))

    def read_notes(self, path: Path) -> Mapping[str, Any]:
        """Read the notes of a weights file; raise a WeightsError if it is missing."""
        return read_notes(path)

    def export(self, folder: Path) -> Path | None:
        """Write the best weights as an ONNX file; return its path, or None if there is none."""
        return None

    def training_step(self, batch: Any, step: int) -> float:
        """Take one optimiser step on a batch; return the loss. Steps are numbered from 0.

        Raises:
            OptionError: the loss or its gradients are not finite.
        """
        for optimizer in self.optimizers:
            optimizer.zero_grad(set_to_none=True)
            for group in optimizer.param_groups:
                group["lr"] = self.learning_rate(step) * group.get("rate_factor", 1)
        loss = self.loss(batch)
        loss.backward()
        value = loss.item()
        norm = clip_grad_norm_(self.network.parameters(), self.max_gradient_norm)
        # In bfloat16, gradients may be infinite or NaN even if the loss is finite.
        if not (math.isfinite(value) and norm.isfinite()):
            raise OptionError(
                f"the loss or its gradients are not finite at step {step}: start again with a "
                "lower `learning_rate`, or in float32"
            )
        for optimizer in self.optimizers:
            optimizer.step()
        # At first, the decay is smaller, so that the average soon forgets the initial weights.
        decay = min(self.average_decay, (1 + step) / (10 + step))
        states = (module.state_dict().values() for module in (self.average, self.network))
        for mean, state in zip(*states, strict=True):
            if mean.is_floating_point():
                mean.lerp_(state, 1 - decay)
            else:  # an integer: the number of batches that a batch normalisation has seen
                mean.copy_(state)
        return value

    def fit(self, folder: Path, log: Callable[[str], None] | None = None) -> TrainingResult:
        """Train to the last step, and resume if the folder has a checkpoint.

        Raises:
            OptionError: the folder holds a run with other options, images or initial weights.
            WeightsError: the checkpoint is damaged, or the file of the best weights is missing.
        """
        state = self._resume(folder)
        if log is not None and state.step < self.steps:
            for line in self.introduction:
                log(line)
        measured = {point["step"] for point in state.points}
        if state.step in self.milestones and state.step not in measured:
            self._validate(state, folder)  # before step 0, or if this validation was interrupted
        saved = time.monotonic()
        bar = progress(self.steps, "training", "step", log is None, state.step)
        with bar, loading(self.loader(state.step)) as batches:
            for batch in batches:
                state.loss_sum += self.training_step(batch, state.step)
                state.loss_count += 1
                state.step += 1
                bar.update(1)
                text = f"loss {state.loss_sum / state.loss_count:.4f}"
                if state.points:
                    text += f", best {self._best(state)[self.objective]:.4f}"
                bar.set_postfix_str(text, False)
                if state.step in self.milestones:
                    self._save(state, folder)  # a run may be interrupted while it validates
                    self._validate(state, folder)
                if time.monotonic() - saved >= CHECKPOINT_INTERVAL_S:
                    self._save(state, folder)
                    saved = time.monotonic()
        best, weights = self._best(state), folder / self.weights_file
        onnx = self.export(folder)
        self._write_card(folder, state.points, best)
        return TrainingResult(weights, onnx, state.points, best)

    def _best(self, state: TrainingState) -> Point:
        return min(state.points, key=lambda point: self.sign * point[self.objective])

    def _validate(self, state: TrainingState, folder: Path) -> None:
        """Validate the weights, save them if they are the best so far, and write a checkpoint."""
        loss = state.loss_sum / max(state.loss_count, 1)
        point = {"step": state.step, "training_loss": loss, **self.validate(state.step)}
        state.loss_sum, state.loss_count = 0.0, 0
        state.points.append(point)
        if self._best(state) is point:
            notes = {**self._all_notes(), "point": json.dumps(point)}
            self.save(folder / self.weights_file, notes)
        save_curves(state.points, folder)
        self._save(state, folder)

    def _save(self, state: TrainingState, folder: Path) -> None:
        metadata = {**dataclasses.asdict(state), "inputs": self._inputs(), **self._all_notes()}
        modules = self.network, self.average
        save_checkpoint(folder / CHECKPOINT, *modules, self.optimizers, metadata)

    def _resume(self, folder: Path) -> TrainingState:
        if not (folder / CHECKPOINT).exists():
            return TrainingState()
        tensors, metadata = read_checkpoint(folder / CHECKPOINT)
        advice = "use the same settings to resume the run, or choose another `output`"
        check_same(folder, metadata.get("inputs"), self._inputs(), advice)
        names = [each.name for each in dataclasses.fields(TrainingState)]
        state = TrainingState(**{name: metadata[name] for name in names})
        restore(tensors, self.network, self.average, self.optimizers)
        if state.points:
            self.read_notes(folder / self.weights_file)  # fails now if the file is missing
        return state

    def _inputs(self) -> dict[str, Any]:
        return {**plain(self.options), **self.origin}

    def _all_notes(self) -> dict[str, Any]:
        recipe = json.dumps(dataclasses.asdict(self.options), sort_keys=True)
        return {"options": recipe, **self.origin, **self.notes, **provenance()}

    def _write_card(self, folder: Path, points: Sequence[Point], best: Point) -> None:
        weights = folder / self.weights_file
        notes, count = self.read_notes(weights), sum(p.numel() for p in self.network.parameters())
        known = ("command", "options", "point")
        options = json.loads(notes["options"])
        best_rows = [{"measure": k.replace("_", " "), "value": v} for k, v in best.items()]
        recipe = [{"option": name, "value": json.dumps(value)} for name, value in options.items()]
        lines = [
            "# Model card",
            "",
            f"`{weights.name}`, SHA-256 `{file_digest(weights)}`:",
            f"a network of {count:,} parameters {self.purpose}.",
            "",
            "## How good the weights are",
            "",
            f"{self.measures}. The weights are those with the best "
            f"{self.objective.replace('_', ' ')}.",
            "",
            Table("best", "", {"measure": "", "value": ".4f"}, best_rows).to_markdown(),
            "",
            "## Where they come from",
            "",
            "```sh",
            notes["command"],
            "```",
            "",
            *(f"- {name.replace('_', ' ')}: {notes[name]}" for name in notes if name not in known),
            "",
            "## Recipe",
            "",
            Table("recipe", "", {"option": "", "value": ""}, recipe).to_markdown(),
            "",
            "## Curves",
            "",
            _curves(points).to_markdown(),
            "",
        ]
        with atomic_path(folder / CARD) as temporary:
            temporary.write_text("\n".join(lines), encoding="utf-8")


def seeded(make: Callable[[], Network], seed: int) -> Network:
    """Make a network with random weights from a seed, and keep the caller's random state."""
    with torch.random.fork_rng(devices=()):
        torch.default_generator.manual_seed(seed)
        return make()


def digests(images: Sequence[Path], validation: Sequence[Path]) -> dict[str, str]:
    """Return digests of the training and the validation images, for `Trainer.origin`."""
    return {"images_digest": key(images)[:16], "validation_digest": key(validation)[:16]}


def with_plateau(step: int, steps: int, warm_up: float, decay_share: float) -> float:
    """Return the factor by which the highest learning rate is multiplied in a step.

    The factor rises linearly to 1 over the first `warm_up` steps, stays there, and falls linearly
    to 0 over the last share `decay_share` of the steps.
    """
    return min(1, (step + 1) / warm_up, (1 - step / steps) / decay_share)


def save_curves(points: Sequence[Point], folder: Path) -> None:
    """Write the training curves to curves.csv and curves.png (paper, Figure 5)."""
    with atomic_path(folder / "curves.csv") as temporary:
        temporary.write_text(_curves(points).to_csv(), newline="")
    steps = [point["step"] for point in points]
    lines = {
        name.replace("_", " "): (steps, [point[name] for point in points])
        for name in points[0]
        if name.endswith(("loss", "score", "correct"))
    }
    with atomic_path(folder / "curves.png") as temporary:
        temporary.write_bytes(line_chart(lines, "step", ""))


def _curves(points: Sequence[Point]) -> Table:
    styles = {name: "d" if isinstance(value, int) else ".6g" for name, value in points[0].items()}
    return Table("curves", "", styles, points)
