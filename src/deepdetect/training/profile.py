"""How fast a run would go, and what holds it back."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

from .batches import Batches
from .learner import Learner
from .recipe import Stage

WARM_UP_STEPS = 5  # compilation, memory, the first views


@dataclass(frozen=True)
class StageProfile:
    """The speed of one stage, over all processes.

    Attributes:
        stage: the stage.
        steps: steps that were timed.
        images_per_second: crops a second.
        full_images_per_second: the same in 480x480 images' worth of pixels.
        waiting_share: share of the time in which the first process waited for data.
        memory: peak resident memory of the first process up to here, in bytes, or None
            where the system does not tell.
        device_memory: peak memory that torch took on the first process's GPU, in bytes, or None.
    """

    stage: Stage
    steps: int
    images_per_second: float
    full_images_per_second: float
    waiting_share: float
    memory: int | None
    device_memory: int | None


def profile_stages(
    learner: Learner, batches: Batches, steps: int, done: Callable[[int], object] = lambda _: None
) -> list[StageProfile]:
    """Train for some steps of each stage and time them; nothing is written.

    Args:
        learner: the network.
        batches: its batches.
        steps: steps to time in each stage, after a few that are not.
        done: called with 1 after each step.

    Returns:
        One profile a stage.
    """
    profiles = []
    first = 0
    for stage, length in zip(
        batches.schedule.options.stages, batches.schedule.steps_of_stage, strict=True
    ):
        last = first + min(length, steps + WARM_UP_STEPS)
        profiles.append(_profile(learner, batches, stage, first, last, done))
        first += length
    return profiles


def _profile(
    learner: Learner,
    batches: Batches,
    stage: Stage,
    first: int,
    last: int,
    done: Callable[[int], object],
) -> StageProfile:
    warm = min(WARM_UP_STEPS, last - first - 1)
    on_gpu = learner.engine.device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    stream = batches.stream(first, last)
    waited = 0.0
    started = time.perf_counter()
    for step in range(first, last):
        asked = time.perf_counter()
        if step == first + warm:
            waited, started = 0.0, asked
        rgb, masks = next(stream)
        waited += time.perf_counter() - asked
        learner.training_step(rgb, masks, batches.schedule.learning_rate(step), step)
        done(1)
    # Reading the loss has waited for the GPU at each step.
    seconds = time.perf_counter() - started
    rate = (last - first - warm) * stage.batch / seconds
    return StageProfile(
        stage=stage,
        steps=last - first - warm,
        images_per_second=rate,
        full_images_per_second=rate * stage.crop**2 / 480**2,
        waiting_share=waited / seconds,
        memory=_peak_memory(),
        device_memory=torch.cuda.max_memory_allocated() if on_gpu else None,
    )


def _peak_memory() -> int | None:
    """Return this process's peak resident memory in bytes."""
    if sys.platform == "win32":
        return None
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
