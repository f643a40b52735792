"""How fast a run would be, and what limits it."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from .._shared.options import suggest_keywords
from .._shared.progress import progress
from .dataset import loading
from .recipe import DeviceOptions, Stage, TrainingOptions
from .trainer import InitWeights, Trainer, make_trainer

WARM_UP_STEPS = 5  # compilation, memory, the first views


@dataclass(frozen=True)
class StageProfile:
    """The speed of one stage, over all processes.

    Attributes:
        stage: the stage.
        steps: steps that were timed.
        images_per_second: crops per second.
        full_images_per_second: the same in 480x480 images' worth of pixels.
        waiting_fraction: fraction of the time in which the main process waited for data.
        memory_bytes: peak resident memory of the main process so far, or None where the system
            does not report it.
        device_memory_bytes: peak memory of torch on the main process's GPU, or None.
    """

    stage: Stage
    steps: int
    images_per_second: float
    full_images_per_second: float
    waiting_fraction: float
    memory_bytes: int | None
    device_memory_bytes: int | None


@suggest_keywords
def profile(
    images: str | Path,
    output: str | Path,
    options: TrainingOptions = TrainingOptions(),
    *,
    steps: int = 30,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    init_weights: InitWeights | None = None,
    device: DeviceOptions = DeviceOptions(),
    workers: int | None = None,
    log: Callable[[str], None] | None = None,
) -> list[StageProfile]:
    """Time some steps of each stage of a run; nothing but the label cache is written.

    Args:
        steps: steps to time in each stage, after a few that are not timed.
        images, output, options, validation, labels, init_weights, device, workers, log: as of
            `train`.

    Returns:
        One profile per stage.

    Raises:
        The errors of `train`.

    Example:
        >>> profile("images", "run")[0].images_per_second  # doctest: +SKIP
    """
    options = dataclasses.replace(options, interleave=False)  # each stage by itself
    trainer = make_trainer(
        images, output, options, validation, labels, init_weights, device, workers, log, False
    )
    lengths = [min(n, steps + WARM_UP_STEPS) for n in trainer.schedule.steps_of_stage]
    if trainer.log is not None:
        trainer.log(f"timing {trainer.engine.describe()}")
    profiles, first = [], 0
    with progress(sum(lengths), "timing", "step", trainer.log is None) as bar:
        for stage, length, whole in zip(
            options.stages, lengths, trainer.schedule.steps_of_stage, strict=True
        ):
            profiles.append(_profile(trainer, stage, first, first + length, bar.update))
            first += whole
    trainer.engine.close()
    return profiles


def _profile(
    trainer: Trainer, stage: Stage, first: int, last: int, done: Callable[[int], object]
) -> StageProfile:
    warm_up = min(WARM_UP_STEPS, last - first - 1)
    on_gpu = trainer.engine.device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    waited = 0.0
    started = time.perf_counter()
    with loading(trainer.loader(first, last)) as batches:
        for step in range(first, last):
            asked = time.perf_counter()
            if step == first + warm_up:
                waited, started = 0.0, asked
            images, masks = next(batches)
            waited += time.perf_counter() - asked
            trainer.learner.training_step(images, masks, trainer.schedule.learning_rate(step), step)
            done(1)
    # Reading the loss has waited for the GPU at each step.
    seconds = time.perf_counter() - started
    rate = (last - first - warm_up) * stage.batch / seconds
    return StageProfile(
        stage=stage,
        steps=last - first - warm_up,
        images_per_second=rate,
        full_images_per_second=rate * stage.crop**2 / 480**2,
        waiting_fraction=waited / seconds,
        memory_bytes=_peak_memory_bytes(),
        device_memory_bytes=torch.cuda.max_memory_allocated() if on_gpu else None,
    )


def _peak_memory_bytes() -> int | None:
    """Return this process's peak resident memory."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
