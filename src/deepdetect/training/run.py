"""One training run: where it stands, its files, and how it goes on after a break."""

from __future__ import annotations

import dataclasses
import itertools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .._shared.errors import OptionError, WeightsError
from .._shared.progress import progress
from .._shared.provenance import provenance
from ..detector.network.espnet import ESPNet
from ..detector.network.onnx_export import export_onnx
from ..detector.network.weights import load_network, read_notes, save_weights, weights_digest
from ..evaluation.mask_scores import MaskScore, mean_score
from .batches import Batches
from .checkpoint import Checkpoint, read_checkpoint, restore, save_checkpoint
from .curves import CurvePoint, save_curves
from .device import DeviceOptions
from .learner import Learner
from .model_card import write_model_card
from .photos import Photo
from .prefetch import prefetched
from .preparation import Photographs
from .recipe import TrainingOptions
from .schedule import Schedule
from .validation import score_network
from .views import View

CHECKPOINT = "checkpoint.safetensors"
BEST = "best.safetensors"
ONNX = "deepdetect.onnx"
CARD = "MODEL_CARD.md"
CHECKPOINT_SECONDS = 60.0  # a killed run loses at most so much


@dataclass(frozen=True)
class TrainingResult:
    """What a run has made.

    Attributes:
        weights: safetensors file of the weights with the lowest validation loss.
        onnx: the same weights as ONNX, fit for `DeepDetect(weights=...)`.
        points: the loss curves.
        best: the point of those weights.
        images_per_second: mean rate of this process, in 480x480 images' worth of pixels.
    """

    weights: Path
    onnx: Path
    points: list[CurvePoint]
    best: CurvePoint
    images_per_second: float


class Run:
    """The state of one run: where it stands, its files, its losses.

    Args:
        photographs: what is trained on and validated with.
        folder: where the files go.
        options: the recipe.
        device: how the network is run.
        network: the network with the weights that it starts from.
        log: takes lines of text for the user; without it there is no progress bar either.
        resume: go on from the folder's checkpoint.

    Raises:
        OptionError: the folder holds a run with other options.
    """

    def __init__(
        self,
        photographs: Photographs,
        folder: Path,
        options: TrainingOptions,
        device: DeviceOptions,
        network: ESPNet,
        log: Callable[[str], None] | None = None,
        resume: bool = True,
    ) -> None:
        self.photographs, self.folder, self.options = photographs, folder, options
        self.start = weights_digest(network)
        self.schedule = Schedule(options, len(photographs.training))
        self.learner = Learner(
            network,
            device,
            options.optimizer,
            bool(options.frozen_batch_norm),
            options.pos_weight,
            options.low_light_pos_weight,
            options.pos_weight_uncertain,
            options.freeze_encoder,
        )
        self.engine, self.network = self.learner.engine, self.learner.network
        self.place = self.engine.place
        self.log = log if self.place.is_first else None
        self.batches = Batches(
            photographs.training, self.schedule, self.place, self.engine.num_workers
        )
        self.origin = {**provenance(), "run_on": self.engine.describe()}
        self._check_agreement()
        self.step = 0
        self.images = 0
        self.loss_sum, self.loss_count = 0.0, 0
        self.points: list[CurvePoint] = []
        if resume:
            self._resume()

    def fit(self) -> TrainingResult:
        """Train to the last step."""
        milestones = self.schedule.milestones(self.options.val_count)
        started, pixels = time.monotonic(), 0
        saved = started
        if self.step < self.schedule.steps and self.log is not None:
            self.log(f"training on {self.engine.describe()}")
        if self.step in milestones and self.step not in {point.step for point in self.points}:
            self._validate()  # the run was killed while it validated
        bar = progress(self.schedule.steps, "training", "step", self.log is None, self.step)
        with bar:
            for rgb, masks in self.batches.stream(self.step):
                rate = self.schedule.learning_rate(self.step)
                loss = self.learner.training_step(rgb, masks, rate, self.step)
                batch = len(masks) * self.place.processes
                pixels += batch * masks[0].size
                self.loss_sum += loss
                self.loss_count += 1
                self.step += 1
                self.images += batch
                bar.update(1)
                rate = pixels / (480 * 480) / (time.monotonic() - started)
                bar.set_postfix_str(
                    f"loss {self.loss_sum / self.loss_count:.4f}, {rate:.1f} images/s", False
                )
                if self.step in milestones:
                    self._save()  # the validation takes its time too
                    self._validate()
                if self.step in milestones or time.monotonic() - saved > CHECKPOINT_SECONDS:
                    self._save()
                    saved = time.monotonic()
        seconds = max(time.monotonic() - started, 1e-9)
        best = min(self.points, key=lambda point: point.validation_loss)
        if self.place.is_first:
            export_onnx(load_network(self.folder / BEST), self.folder / ONNX)
            notes = read_notes(self.folder / BEST)
            write_model_card(self.folder / CARD, self.folder / BEST, notes, self.points)
        rate = pixels / (480 * 480) / seconds
        return TrainingResult(self.folder / BEST, self.folder / ONNX, self.points, best, rate)

    def _validate(self) -> None:
        """Take the validation losses; keep the weights when they are the best so far."""
        normal = self._score(lambda photo: photo.normal[0])
        dark = self._score(lambda photo: photo.dark[0])
        share = self.options.dark_fraction
        point = CurvePoint(
            step=self.step,
            epoch=self.images / self.schedule.photos,
            images=self.images,
            learning_rate=self.schedule.learning_rate(self.step - 1),
            training_loss=self.loss_sum / self.loss_count,
            validation_loss=(1 - share) * normal.loss + share * dark.loss,
            normal_loss=normal.loss,
            normal_iou=normal.iou,
            dark_loss=dark.loss,
            dark_iou=dark.iou,
        )
        self.loss_sum, self.loss_count = 0.0, 0
        best = min((p.validation_loss for p in self.points), default=float("inf"))
        self.points.append(point)
        if self.place.is_first:
            if point.validation_loss < best:
                save_weights(self.network, self.folder / BEST, self._provenance(point))
            save_curves(self.points, self.folder)

    def _check_agreement(self) -> None:
        """Make sure that all processes do the same run: each has read its own files."""
        mine = (self.photographs.digest, self.options.to_json(), self.start)
        if any(theirs != mine for theirs in self.engine.gather(mine)):
            raise OptionError(
                "the processes do not train on the same photographs with the same options: "
                "every machine needs the same files and the same command"
            )

    def _score(self, view_of: Callable[[Photo], View]) -> MaskScore:
        """Score the network on a view of the photographs held out, shared by the processes."""
        held = iter(self.photographs.held)
        mine = itertools.islice(held, self.place.rank, None, self.place.processes)
        num_workers = self.engine.num_workers
        pairs = prefetched(
            lambda example: example.load(view_of(example.photo)), mine, num_workers, num_workers + 1
        )
        scores = score_network(self.network, pairs, self.engine.device)
        return mean_score(self.engine.gather(scores))

    def _provenance(self, point: CurvePoint) -> dict[str, str]:
        """Return what is written into the weights' file."""
        return {
            "options": self.options.to_json(),
            "photographs": str(self.schedule.photos),
            "photographs_digest": self.photographs.digest,
            "start": self.start,
            "point": json.dumps(dataclasses.asdict(point)),
            **self.origin,
        }

    def _save(self) -> None:
        if not self.place.is_first:
            return
        state = {
            "options": self.options.to_json(),
            "photographs": self.photographs.digest,
            "start": self.start,
            "step": self.step,
            "images": self.images,
            "loss_sum": self.loss_sum,
            "loss_count": self.loss_count,
            "points": [dataclasses.asdict(point) for point in self.points],
            **self.origin,
        }
        save_checkpoint(self.folder / CHECKPOINT, self.network, self.learner.optimizers, state)

    def _resume(self) -> None:
        """Go on from the checkpoint that the first process finds."""
        path = self.folder / CHECKPOINT
        found: Checkpoint | WeightsError | None = None
        if self.place.is_first and path.exists():
            try:
                found = read_checkpoint(path)
            except WeightsError as error:
                found = error
        found = self.engine.broadcast(found)
        if isinstance(found, WeightsError):
            raise found  # by all processes, so that none waits for another
        if found is None:
            return
        state = found.state
        other_start = state["start"] != self.start
        others = _difference(state["options"], self.options)
        # Whether the statistics are frozen follows from the start, which is told below.
        if others and not (other_start and others == ["frozen_batch_norm"]):
            raise OptionError(
                f"{self.folder} holds a run with other options ({', '.join(others)}): "
                "use the same options to continue it, or another folder with -o"
            )
        if state["photographs"] != self.photographs.digest:
            raise OptionError(
                f"{self.folder} holds a run over other photographs: use the same ones, to train "
                "on and to validate with, or another folder with -o"
            )
        if other_start:
            raise OptionError(
                f"{self.folder} holds a run that started from other weights: "
                "start from the same ones to continue it, or use another folder with -o"
            )
        restore(found, path, self.network, self.learner.optimizers)
        self.step, self.images = state["step"], state["images"]
        self.loss_sum, self.loss_count = state["loss_sum"], state["loss_count"]
        self.points = [CurvePoint(**point) for point in state["points"]]


def _difference(stored: str, options: TrainingOptions) -> list[str]:
    """Name the options that differ between a checkpoint and this run.

    What a run of an older version lacks was not there, or had the value of today's default.
    """
    now = json.loads(options.to_json())
    older = TrainingOptions(
        frozen_batch_norm=False, flips=True, transpositions=False, color_jitter=0.0
    )
    before = {**json.loads(older.to_json()), **json.loads(stored)}
    before["stages"] = [{"sides": [], **stage} for stage in before["stages"]]
    return sorted(name for name in {**before, **now} if before.get(name) != now.get(name))
