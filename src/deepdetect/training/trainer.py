"""The training loop (paper, Section III-B)."""

from __future__ import annotations

import dataclasses
import json
import math
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.nn.functional import binary_cross_entropy_with_logits

from ..errors import OptionError
from ..mask_scores import MaskScore
from ..network.espnet import ESPNet
from ..network.onnx_export import export_onnx
from ..network.weights import load_network, save_weights, weights_digest
from ..progress import progress
from .batches import Batches
from .checkpoint import load_checkpoint, save_checkpoint
from .curves import CurvePoint, save_curves
from .device import DeviceOptions, Engine
from .label_cache import LabelCache
from .photos import Photo, hold_out, list_photos, photos_digest
from .recipe import Schedule, TrainingOptions
from .validation import score_network
from .view_store import ViewStore
from .views import View

CHECKPOINT = "checkpoint.safetensors"
BEST = "best.safetensors"
ONNX = "deepdetect.onnx"
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


def train(
    photos: str | Path,
    output: str | Path,
    options: TrainingOptions = TrainingOptions(),
    *,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    start: str | Path | None = None,
    device: DeviceOptions = DeviceOptions(),
    workers: int | None = None,
    say: Callable[[str], None] | None = None,
) -> TrainingResult:
    """Train the network on a folder of photographs.

    A run that was killed goes on from its last checkpoint when it is started again
    with the same options, with the same result as an unbroken one. Labels are made in
    processes of their own, so a script must call this under `if __name__ == "__main__":`.

    Args:
        photos: folder of photographs.
        output: folder for checkpoint.safetensors, best.safetensors, deepdetect.onnx
            and the loss curves.
        options: the recipe.
        validation: folder of other photographs; default: every twentieth is held out.
        labels: folder for the label cache; default: in `output`.
        start: weights (.safetensors) to start from; default: random ones, by the seed.
        device: how the network is run.
        workers: processes that make labels; default one for each processor.
        say: takes the one line that says how the network is run; without it there is
            no progress bar either.

    Returns:
        The weights' files and the curves.

    Raises:
        ImageError: a folder is missing or empty, or a photograph cannot be read.
        OptionError: the folder holds a run with other options.
        WeightsError: the weights to start from are missing or do not fit.

    Example:
        >>> train("photographs", "run")  # doctest: +SKIP
    """
    # Before the labels, which take minutes.
    network = None if start is None else load_network(start)
    folder = Path(output)
    cache = Path(labels) if labels is not None else folder / "labels"
    training = list_photos(Path(photos), options, exclude=(folder, cache))
    if validation is None:
        training, held = hold_out(training)
    else:
        held = list_photos(Path(validation), options, exclude=(folder, cache))
    store = ViewStore(LabelCache(cache, options.detectors))
    wanted = [(photo, photo.normal + photo.dark) for photo in training]
    wanted += [(photo, (_largest(photo.normal), _largest(photo.dark))) for photo in held]
    store.labels.make(wanted, workers, quiet=say is None)
    return _Run(training, held, store, folder, options, device, say, network).finish()


def _largest(views: Sequence[View]) -> View:
    """Return the first view of the largest size, which validation takes."""
    return max(views, key=lambda view: view.short_side)


class _Run:
    """The state of one run."""

    def __init__(
        self,
        training: list[Photo],
        held: list[Photo],
        store: ViewStore,
        folder: Path,
        options: TrainingOptions,
        device: DeviceOptions,
        say: Callable[[str], None] | None,
        start: ESPNet | None,
    ) -> None:
        self.held, self.store = held, store
        self.folder, self.options, self.say = folder, options, say
        self.schedule = Schedule(options, len(training))
        self.batches = Batches(training, store, self.schedule)
        self.digest = photos_digest(training, held)
        torch.manual_seed(options.seed)
        network = ESPNet() if start is None else start
        self.start = "" if start is None else weights_digest(start)
        self.engine = Engine(network, device)
        self.network = self.engine.network
        self.optimizer = torch.optim.Adam(
            self.network.parameters(), lr=options.learning_rate, fused=True
        )
        self.step = 0
        self.images = 0
        self.loss_sum, self.loss_count = 0.0, 0
        self.points: list[CurvePoint] = []
        self._resume()

    def finish(self) -> TrainingResult:
        """Train to the last step."""
        milestones = self.schedule.milestones(self.options.validations)
        started, pixels = time.monotonic(), 0
        saved = started
        if self.step < self.schedule.steps and self.say is not None:
            self.say(f"training on {self.engine.describe()}")
        if self.step in milestones and self.step not in {point.step for point in self.points}:
            self._validate()  # the run was killed while it validated
        bar = progress(self.schedule.steps, "training", "step", self.say is None, self.step)
        with bar:
            for rgb, masks in self.batches.stream(self.step):
                loss = self._learn(rgb, masks)
                pixels += masks.size
                self.loss_sum += loss
                self.loss_count += 1
                self.step += 1
                self.images += len(masks)
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
        export_onnx(load_network(self.folder / BEST), self.folder / ONNX)
        rate = pixels / (480 * 480) / seconds
        return TrainingResult(self.folder / BEST, self.folder / ONNX, self.points, best, rate)

    def _learn(self, rgb: np.ndarray, masks: np.ndarray) -> float:
        """Make one optimiser step; return the loss."""
        self.network.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self.schedule.learning_rate(self.step)
        images = self.engine.images(torch.from_numpy(rgb))
        truth = torch.from_numpy(masks).to(self.engine.device)[:, None].float()
        self.optimizer.zero_grad(set_to_none=True)
        loss = binary_cross_entropy_with_logits(self.engine.logits(images), truth)
        loss.backward()
        gradients = [p.grad for p in self.network.parameters() if p.grad is not None]
        # A finite loss can have gradients that are not, in bfloat16.
        value = loss.item() if torch.nn.utils.get_total_norm(gradients).isfinite() else math.nan
        if not math.isfinite(value):
            raise OptionError(
                f"the loss or its gradients are not finite at step {self.step}: start again with "
                "--precision float32, or with a lower --learning-rate"
            )
        self.optimizer.step()
        return value

    def _validate(self) -> None:
        """Take the validation losses; keep the weights when they are the best so far."""
        normal = self._score([_largest(photo.normal) for photo in self.held])
        dark = self._score([_largest(photo.dark) for photo in self.held])
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
        if point.validation_loss < best:
            save_weights(self.network, self.folder / BEST, self._provenance(point))
        save_curves(self.points, self.folder)

    def _score(self, views: list) -> MaskScore:
        pairs = (self.store.load(photo, view) for photo, view in zip(self.held, views, strict=True))
        return score_network(self.network, pairs, self.engine.device)

    def _provenance(self, point: CurvePoint) -> dict[str, str]:
        """Return what is written into the weights' file."""
        return {
            "options": self.options.to_json(),
            "photographs": str(self.schedule.photos),
            "photographs_digest": self.digest,
            "start": self.start,
            "point": json.dumps(dataclasses.asdict(point)),
            "torch": torch.__version__,
            "python": platform.python_version(),
        }

    def _save(self) -> None:
        state = {
            "options": self.options.to_json(),
            "photographs": self.digest,
            "start": self.start,
            "step": self.step,
            "images": self.images,
            "loss_sum": self.loss_sum,
            "loss_count": self.loss_count,
            "points": [dataclasses.asdict(point) for point in self.points],
        }
        save_checkpoint(self.folder / CHECKPOINT, self.network, self.optimizer, state)

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT
        if not path.exists():
            return
        state = load_checkpoint(path, self.network, self.optimizer)
        if state["options"] != self.options.to_json():
            raise OptionError(
                f"{self.folder} holds a run with other options "
                f"({_difference(state, self.options)}): "
                "use the same options to continue it, or another folder with -o"
            )
        if state["photographs"] != self.digest:
            raise OptionError(
                f"{self.folder} holds a run over other photographs: use the same ones, to train "
                "on and to validate with, or another folder with -o"
            )
        if state["start"] != self.start:
            raise OptionError(
                f"{self.folder} holds a run that started from other weights: "
                "start from the same ones to continue it, or use another folder with -o"
            )
        self.step, self.images = state["step"], state["images"]
        self.loss_sum, self.loss_count = state["loss_sum"], state["loss_count"]
        self.points = [CurvePoint(**point) for point in state["points"]]


def _difference(state: dict, options: TrainingOptions) -> str:
    """Name the options that differ between a checkpoint and this run."""
    before, now = json.loads(state["options"]), json.loads(options.to_json())
    names = [name for name in now if before.get(name) != now[name]]
    return ", ".join(names) or "an older version"
