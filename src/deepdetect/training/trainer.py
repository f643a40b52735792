"""Training the network on a folder of images (paper, Section III-B)."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from .._shared.errors import OptionError, WeightsError
from .._shared.progress import progress
from .._shared.provenance import provenance
from ..detector.network.espnet import ESPNet
from ..detector.network.onnx_export import export_onnx
from ..detector.network.weights import (
    average_weights,
    load_network,
    read_notes,
    save_weights,
    weights_digest,
)
from ..detector.pretrained import resolve_weights
from ..evaluation.metrics.masks import MaskScore, mean_score
from .checkpoint import (
    Checkpoint,
    TrainingState,
    read_checkpoint,
    read_point,
    restore,
    save_checkpoint,
)
from .dataset import CropDataset, TrainingData, ValidationDataset, loading, prepare_data
from .learner import Learner
from .model_card import CurvePoint, save_curves, write_model_card
from .recipe import DeviceOptions, InitWeights, TrainingOptions
from .sampler import CropSampler, Schedule

CHECKPOINT = "checkpoint.safetensors"
BEST = "best.safetensors"
ONNX = "deepdetect.onnx"
CARD = "MODEL_CARD.md"
FULL_IMAGE_PIXELS = 480 * 480

SAME_RUN = ("options", "start", "photographs", "photographs_digest")
"""Notes of weights that tell their run."""


@dataclass(frozen=True)
class TrainingResult:
    """The results of a run.

    Attributes:
        weights: safetensors file of the weights with the lowest validation loss.
        onnx: the same weights as ONNX, for `DeepDetect(weights=...)`.
        points: the loss curves.
        best: the point of those weights.
        images_per_second: mean rate, in 480x480 images' worth of pixels.
    """

    weights: Path
    onnx: Path
    points: list[CurvePoint]
    best: CurvePoint
    images_per_second: float


def make_trainer(
    images: str | Path,
    output: str | Path,
    options: TrainingOptions,
    validation: str | Path | None,
    labels: str | Path | None,
    init_weights: InitWeights | None,
    device: DeviceOptions,
    workers: int | None,
    log: Callable[[str], None] | None,
    resume: bool = True,
) -> Trainer:
    """Make the labels, and a trainer where its last checkpoint left off; arguments of `train`."""
    options, network = _initial_network(options, init_weights)  # before the labels, for its errors
    data = prepare_data(
        images,
        options,
        output,
        validation=validation,
        labels=labels,
        workers=workers,
        device=device,
        quiet=log is None,
    )
    return Trainer(data, Path(output), options, device, network, log, resume)


class Trainer:
    """One training run: its data, network, files and state; arguments as of `train`.

    Raises:
        OptionError: the folder holds a run with other options.
        WeightsError: its checkpoint is damaged.
    """

    def __init__(
        self,
        data: TrainingData,
        folder: Path,
        options: TrainingOptions,
        device: DeviceOptions,
        network: ESPNet,
        log: Callable[[str], None] | None = None,
        resume: bool = True,
    ) -> None:
        self.data, self.folder, self.options = data, folder, options
        init_digest = weights_digest(network)
        self.schedule = Schedule(options, len(data.training))
        self.learner = Learner(network, device, options)
        self.engine, self.network = self.learner.engine, self.learner.network
        self.context = self.engine.context
        self.device = device
        self.log = log if self.context.is_main else None
        self.run = {
            "options": options.to_json(),
            "photographs": data.digest,
            "start": init_digest,
        }
        self.metadata = {**provenance(), "run_on": self.engine.describe()}
        self.state = TrainingState()
        self.best: CurvePoint | None = None
        if any(run != self.run for run in self.engine.all_gather(self.run)):
            raise OptionError(
                "the processes do not train on the same images with the same options: "
                "every machine needs the same files and the same command"
            )
        if resume:
            self._resume()

    def loader(self, first: int = 0, last: int | None = None) -> DataLoader[Any]:
        """Return the loader of the batches of some steps: (images, masks), see `CropDataset`."""
        sampler = CropSampler(self.schedule, self.data.shard_sizes, self.context, first, last)
        dataset = CropDataset(self.data.training, self.options)
        return self._loader(dataset, batch_sampler=sampler)

    def _loader(self, dataset: Any, **batches: Any) -> DataLoader[Any]:
        return DataLoader(
            dataset,
            num_workers=self.device.worker_count(self.context.local_world_size),
            pin_memory=self.engine.device.type == "cuda",
            generator=torch.Generator(),  # not torch's own, whose state is the user's
            **batches,
        )

    def fit(self) -> TrainingResult:
        """Train to the last step."""
        state, milestones = self.state, self.schedule.milestones(self.options.val_count)
        started, pixels = time.monotonic(), 0
        saved = started
        if state.step < self.schedule.steps and self.log is not None:
            self.log(f"training on {self.engine.describe()}")
            if self.engine.compiled:
                self.log(
                    "the first step of each stage compiles the network, which takes minutes on two "
                    "cores; --no-compile starts at once, and each step takes longer"
                )
        if state.step in milestones and state.step not in {point.step for point in state.points}:
            self._validate()  # the run was interrupted while it validated
        if state.step == self.schedule.steps and self.best is None and self.context.is_main:
            self._keep(state.points[-1])  # they were damaged, and no further validation comes
        bar = progress(self.schedule.steps, "training", "step", self.log is None, state.step)
        with bar, loading(self.loader(state.step)) as batches:
            for images, masks in batches:
                rate = self.schedule.learning_rate(state.step)
                state.loss_sum += self.learner.training_step(images, masks, rate, state.step)
                state.loss_count += 1
                state.step += 1
                batch = len(masks) * self.context.world_size
                state.images += batch
                pixels += batch * masks[0].numel()
                bar.update(1)
                speed = pixels / FULL_IMAGE_PIXELS / (time.monotonic() - started)
                loss = state.loss_sum / state.loss_count
                bar.set_postfix_str(f"loss {loss:.4f}, {speed:.1f} images/s", False)
                if state.step in milestones:
                    self._save()  # the validation takes its time, too
                    self._validate()
                interval = self.device.checkpoint_interval_s
                if state.step in milestones or time.monotonic() - saved >= interval:
                    self._save()
                    saved = time.monotonic()
        speed = pixels / FULL_IMAGE_PIXELS / max(time.monotonic() - started, 1e-9)
        return self._result(speed)

    def _result(self, images_per_second: float) -> TrainingResult:
        best = self.engine.fabric.broadcast(self.best)
        if best is None:
            raise WeightsError(
                f"{self.folder / BEST} is missing or damaged: train into another folder"
            )
        if self.context.is_main:
            export_onnx(load_network(self.folder / BEST), self.folder / ONNX)
            metadata = read_notes(self.folder / BEST)
            write_model_card(self.folder / CARD, self.folder / BEST, metadata, self.state.points)
        return TrainingResult(
            weights=self.folder / BEST,
            onnx=self.folder / ONNX,
            points=self.state.points,
            best=best,
            images_per_second=images_per_second,
        )

    def _validate(self) -> None:
        """Compute the validation losses; keep the weights if they are the best so far."""
        dataset = ValidationDataset(self.data.validation, self.context)
        with loading(self._loader(dataset, batch_size=None)) as pairs:
            scores = self.learner.score(pairs)
        normal = self._mean_score(scores[: len(scores) // 2])
        dark = self._mean_score(scores[len(scores) // 2 :])
        fraction, state = self.options.dark_fraction, self.state
        point = CurvePoint(
            step=state.step,
            epoch=state.images / self.schedule.images,
            images=state.images,
            learning_rate=self.schedule.learning_rate(state.step - 1),
            training_loss=state.loss_sum / state.loss_count,
            validation_loss=(1 - fraction) * normal.loss + fraction * dark.loss,
            normal_loss=normal.loss,
            normal_iou=normal.iou,
            dark_loss=dark.loss,
            dark_iou=dark.iou,
        )
        state.loss_sum, state.loss_count = 0.0, 0
        state.points.append(point)
        if not self.context.is_main:
            return
        if self.best is None or point.validation_loss < self.best.validation_loss:
            self._keep(point)
        save_curves(state.points, self.folder)

    def _keep(self, point: CurvePoint) -> None:
        """Write the weights as the best so far."""
        self.best = point
        notes = {**self._notes(), "point": json.dumps(dataclasses.asdict(point))}
        save_weights(self.network, self.folder / BEST, notes)

    def _notes(self) -> dict[str, str]:
        """Return what is written into the weights, but for their point of the loss curves."""
        return {
            **self.run,
            **self.metadata,
            "photographs": str(self.schedule.images),
            "photographs_digest": self.data.digest,
        }

    def _mean_score(self, scores: list[MaskScore]) -> MaskScore:
        """Average over the images of all processes."""
        mine = mean_score(scores) if scores else MaskScore(0.0, 0.0, 0)
        return mean_score(self.engine.all_gather(mine))

    def _save(self) -> None:
        if self.context.is_main:
            metadata = {**dataclasses.asdict(self.state), **self.run, **self.metadata}
            path = self.folder / CHECKPOINT
            save_checkpoint(path, self.network, self.learner.optimizers, metadata)

    def _resume(self) -> None:
        """Resume from the checkpoint that the main process finds."""
        found: Checkpoint | WeightsError | None = None
        if self.context.is_main and (self.folder / CHECKPOINT).exists():
            try:
                found = read_checkpoint(self.folder / CHECKPOINT)
            except WeightsError as error:
                found = error
        found = self.engine.fabric.broadcast(found)
        if isinstance(found, WeightsError):
            raise found  # by all processes, so that none waits for another
        if found is None:
            return
        self._check_same_run(found)
        try:
            state = TrainingState.from_json(found.metadata, self.schedule.steps)
        except ValueError as error:
            raise found.unfit(error) from None
        restore(found, self.network, self.learner.optimizers)
        self.state = state
        self.best = self._read_best()
        if self.best is None and state.points and self.log is not None:
            at_end = state.step == self.schedule.steps
            self.log(
                f"{self.folder / BEST} is missing or damaged: it is written again "
                f"{'with the last weights' if at_end else 'at the next validation'}"
            )

    def _read_best(self) -> CurvePoint | None:
        """Return the point of the best weights so far; None where these are missing or damaged."""
        own = self._notes()
        try:
            tensors = load_network(self.folder / BEST).state_dict().values()
            notes = read_notes(self.folder / BEST)
            point = read_point(json.loads(notes["point"]))
        except (WeightsError, KeyError, ValueError, RecursionError):
            return None
        same_run = all(notes.get(name) == own[name] for name in SAME_RUN)
        whole = own.keys() <= notes.keys() and all(value.isfinite().all() for value in tensors)
        return point if same_run and whole else None

    def _check_same_run(self, checkpoint: Checkpoint) -> None:
        before = checkpoint.metadata
        try:
            others = _different_options(json.loads(before["options"]), self.options)
        except (KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
            raise checkpoint.unfit(error) from None
        other_start = before.get("start") != self.run["start"]
        names = ", ".join(f"`{name}`" for name in others)
        # Whether the statistics are frozen follows from the initial weights, which come last.
        if others and not (other_start and others == ["frozen_batch_norm"]):
            raise OptionError(
                f"{self.folder} holds a run with other options ({names}): "
                "use the same options to resume it, or another `output`"
            )
        if before.get("photographs") != self.data.digest:
            raise OptionError(
                f"{self.folder} holds a run over other images: use the same ones, to train "
                "on and to validate with, or another `output`"
            )
        if other_start:
            raise OptionError(
                f"{self.folder} holds a run that started from other weights: "
                "start from the same ones to resume it, or use another `output`"
            )


def _different_options(before: dict[str, Any], options: TrainingOptions) -> list[str]:
    """Name the options that differ between a checkpoint and this run."""
    now = json.loads(options.to_json())
    return sorted(name for name in {**before, **now} if before.get(name) != now.get(name))


def _initial_network(
    options: TrainingOptions, init_weights: InitWeights | None
) -> tuple[TrainingOptions, ESPNet]:
    """Make the network with its initial weights, and resolve the options that depend on them."""
    if init_weights is not None:
        if options.frozen_batch_norm is None:
            options = dataclasses.replace(options, frozen_batch_norm=True)
        chosen = [init_weights] if isinstance(init_weights, (str, Path)) else list(init_weights)
        return options, average_weights([resolve_weights(name, ".safetensors") for name in chosen])
    for name, what in (("frozen_batch_norm", "batch statistics"), ("freeze_encoder", "encoder")):
        if getattr(options, name):
            raise OptionError(
                f"`{name}` would keep the {what} of random weights: "
                "give trained ones as `init_weights`, or leave it out"
            )
    with torch.random.fork_rng(devices=()):  # the caller's random numbers are left alone
        torch.default_generator.manual_seed(options.seed)
        return dataclasses.replace(options, frozen_batch_norm=False), ESPNet()
