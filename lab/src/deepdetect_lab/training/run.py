"""The trainings, and `profile`: how fast a run would be.

Torch is imported by a run, not with this module: commands that do not train start without it.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from deepdetect._shared.options import suggest_keywords
from deepdetect._shared.progress import progress
from deepdetect.io.image import find_images

from .recipe import (
    DescriptorTrainingOptions,
    DeviceOptions,
    InitWeights,
    MatchFilterTrainingOptions,
    PointsTrainingOptions,
    Stage,
    TrainingOptions,
)

if TYPE_CHECKING:
    from .dense import DenseTrainer
    from .trainer import TrainingResult

Log = Callable[[str], None]


@suggest_keywords
def train(
    images: str | Path,
    output: str | Path,
    options: TrainingOptions = TrainingOptions(),
    *,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    init_weights: InitWeights | None = None,
    device: DeviceOptions = DeviceOptions(),
    workers: int | None = None,
    log: Log | None = None,
) -> TrainingResult:
    """Train the network on a folder of images.

    A run that was interrupted resumes from its last checkpoint when it is started again
    with the same options, with the same result as an uninterrupted one. Labels are made in
    other processes, so a script must call this under `if __name__ == "__main__":`.

    Args:
        images: folder of images, or of shards (`write_shards`).
        output: folder for checkpoint.safetensors, best.safetensors, deepdetect.onnx,
            MODEL_CARD.md and the loss curves.
        options: the recipe.
        validation: folder of other images. None: some of the images are held out.
        labels: folder of the label cache. None: in `output`.
        init_weights: weights (.safetensors) to start from, or "default", "dense", "free" or
            "espnet" inside the package; of several, their mean. None: random ones, by the seed.
        device: how the network is run.
        workers: processes that make labels. None: one per processor.
        log: takes lines of text for the user; without it there is no progress bar either.

    Returns:
        The weights' files and the loss curves.

    Raises:
        ImageError: a folder is missing or empty.
        OptionError: the folder holds a run with other options, the initial weights are of another
            network, or the batch statistics of random weights are to be frozen.
        WeightsError: the initial weights are missing or do not fit.
        DeepDetectError: an image cannot be read.

    Example:
        >>> from deepdetect_lab.training import Stage
        >>> options = TrainingOptions(stages=(Stage(crop=480, batch=16, epochs=20),), seed=1)
        >>> result = train("photos", "run", options)  # doctest: +SKIP
        >>> detector = DeepDetect(result.onnx)  # doctest: +SKIP
    """
    data = {"validation": validation, "labels": labels, "workers": workers}
    trainer = _dense_trainer(images, output, options, init_weights, device, log, data)
    return trainer.fit(Path(output), log)


@suggest_keywords
def train_points(
    images: str | Path,
    validation: str | Path,
    output: str | Path,
    options: PointsTrainingOptions = PointsTrainingOptions(),
    *,
    num_workers: int = 0,
    log: Log | None = None,
) -> TrainingResult:
    """Train the ranker of points on pairs of views that are made of single images.

    An interrupted run resumes as one of `train` does.

    Args:
        images: folder of images.
        validation: folder of other images, which choose the best weights.
        output: folder for checkpoint.safetensors, best.npz, MODEL_CARD.md and the curves.
        options: the recipe.
        num_workers: processes that make the pairs; 0: the training process does.
        log: takes lines of text for the user; without it there is no progress bar either.

    Returns:
        The weights' file and the curves.

    Raises:
        ImageError: a folder is missing or empty.
        OptionError: the folder holds a run with other options or images.
    """
    from .points.task import RankerTrainer

    trainer = RankerTrainer(*_files(images, validation, output), options, num_workers)
    return trainer.fit(Path(output), log)


@suggest_keywords
def train_descriptor(
    images: str | Path,
    validation: str | Path,
    output: str | Path,
    options: DescriptorTrainingOptions = DescriptorTrainingOptions(),
    *,
    init_weights: str | Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    num_workers: int | None = None,
    log: Log | None = None,
) -> TrainingResult:
    """Train the learned descriptor on pairs of views that are made of single images.

    An interrupted run resumes as one of `train` does.

    Args:
        images: folder of images, best of some 480 pixels a side.
        validation: folder of other images, which choose the best weights.
        output: folder for checkpoint.safetensors, descriptor.safetensors, descriptor.onnx,
            MODEL_CARD.md and the curves.
        options, log: as of `train_points`.
        init_weights: weights (descriptor.safetensors) to start from. None: random ones, by the
            seed.
        device: "auto" is CUDA if there is a GPU, else the CPU.
        num_workers: processes that make the pairs; 0: the training process does. None: 0 on a CPU,
            one per processor but one beside a GPU.

    Returns:
        The weights' files, of which `PointDetector` takes the ONNX file, and the curves.

    Raises:
        The errors of `train_points`; an OptionError, too, where the images show nothing.
        WeightsError: the initial weights are missing or do not fit.

    Example:
        >>> result = train_descriptor("photos/train", "photos/val", "run")  # doctest: +SKIP
        >>> PointDetector(descriptor=result.onnx).extract("a.png")  # doctest: +SKIP
    """
    from .descriptor.task import DescriptorTrainer

    where = DeviceOptions(device=device, num_workers=num_workers)
    initial = None if init_weights is None else Path(init_weights)
    trainer = DescriptorTrainer(*_files(images, validation, output), options, initial, where)
    return trainer.fit(Path(output), log)


@suggest_keywords
def train_match_filter(
    images: str | Path,
    validation: str | Path,
    output: str | Path,
    options: MatchFilterTrainingOptions = MatchFilterTrainingOptions(),
    *,
    log: Log | None = None,
) -> TrainingResult:
    """Train the match filter on pairs of views that are made of single images.

    Pairs are drawn, described and matched before the first step, by the bundled descriptors; an
    interrupted run draws the same again. On two processors it takes a quarter of an hour.

    Args:
        images: folder of images.
        validation: folder of other images, which choose the best weights.
        output: folder for checkpoint.safetensors, match_filter.safetensors, match_filter.onnx,
            MODEL_CARD.md and the curves.
        options, log: as of `train_points`.

    Returns:
        The weights' files and the curves.

    Raises:
        The errors of `train_points`; an OptionError, too, where the images show nothing.
    """
    from .match_filter import MatchFilterTrainer

    trainer = MatchFilterTrainer(*_files(images, validation, output), options, log is None)
    return trainer.fit(Path(output), log)


def _files(
    images: str | Path, validation: str | Path, output: str | Path
) -> tuple[list[Path], list[Path]]:
    """List the images to train on, and others to choose weights by, without pictures of the run."""
    images, validation, output = Path(images), Path(validation), Path(output)
    return find_images(images, [output, validation]), find_images(validation, [output, images])


def _dense_trainer(
    images: str | Path,
    output: str | Path,
    options: TrainingOptions,
    init_weights: InitWeights | None,
    device: DeviceOptions,
    log: Log | None,
    data: Mapping[str, Any],
) -> DenseTrainer:
    """Make the labels, and what is trained on them; `data` are further arguments of `train`."""
    from .dataset import prepare_data
    from .dense import DenseTrainer, initial_network

    options, network = initial_network(options, init_weights)  # before the labels, for its errors
    loading = max(1, device.worker_count)
    prepared = prepare_data(images, options, output, **data, processes=loading, quiet=log is None)
    return DenseTrainer(network, options, prepared, device)


TIMED_STEPS = 30
"""Of each stage, by `profile`."""

WARM_UP_STEPS = 5
"""Before them: they compile, allocate memory and render the first views."""


@dataclass(frozen=True)
class StageProfile:
    """The speed of one stage.

    Attributes:
        stage: the stage.
        steps: steps that were timed.
        images_per_second: crops per second.
        full_images_per_second: the same in 480x480 images' worth of pixels.
        waiting_fraction: fraction of the time in which the training waited for data.
        memory_bytes: peak resident memory of the process so far, 0 where unknown.
        device_memory_bytes: peak memory of torch on the GPU, or None.
    """

    stage: Stage
    steps: int
    images_per_second: float
    full_images_per_second: float
    waiting_fraction: float
    memory_bytes: int
    device_memory_bytes: int | None


@suggest_keywords
def profile(
    images: str | Path,
    output: str | Path,
    options: TrainingOptions = TrainingOptions(),
    *,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    init_weights: InitWeights | None = None,
    device: DeviceOptions = DeviceOptions(),
    workers: int | None = None,
    log: Log | None = None,
) -> list[StageProfile]:
    """Time some steps of each stage of a run; nothing but the label cache is written.

    Args:
        images, output, options, validation, labels, init_weights, device, workers, log: as of
            `train`.

    Returns:
        One profile per stage.

    Raises:
        The errors of `train`.

    Example:
        >>> profile("photos", "run")[0].images_per_second  # doctest: +SKIP
    """
    options = dataclasses.replace(options, interleave=False)  # each stage by itself
    data = {"validation": validation, "labels": labels, "workers": workers}
    trainer = _dense_trainer(images, output, options, init_weights, device, log, data)
    steps_of_stage = trainer.schedule.steps_of_stage
    lengths = [min(n, TIMED_STEPS + WARM_UP_STEPS) for n in steps_of_stage]
    if log is not None:
        log(f"timing {trainer.describe()}")
    profiles, first = [], 0
    with progress(sum(lengths), "timing", "step", log is None) as bar:
        for length, whole in zip(lengths, steps_of_stage, strict=True):
            profiles.append(_time_steps(trainer, first, first + length, bar.update))
            first += whole
    return profiles


def _time_steps(
    trainer: DenseTrainer, first: int, last: int, done: Callable[[int], object]
) -> StageProfile:
    import torch

    from ..evaluation.profiling import peak_memory
    from .dataset import loading
    from .trainer import FULL_IMAGE_PIXELS

    stage, warm_up = trainer.schedule.position(first).stage, min(WARM_UP_STEPS, last - first - 1)
    on_gpu = trainer.device.type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats()
    waited = 0.0
    started = time.perf_counter()
    with loading(trainer.loader(first, last)) as batches:
        for step in range(first, last):
            asked = time.perf_counter()
            if step == first + warm_up:
                waited, started = 0.0, asked
            batch = next(batches)
            waited += time.perf_counter() - asked
            trainer.training_step(batch, step)
            done(1)
    # Reading the loss has waited for the GPU at each step.
    seconds = time.perf_counter() - started
    steps = last - first - warm_up
    rate = steps * stage.batch / seconds
    return StageProfile(
        stage=stage,
        steps=steps,
        images_per_second=rate,
        full_images_per_second=rate * stage.crop**2 / FULL_IMAGE_PIXELS,
        waiting_fraction=waited / seconds,
        memory_bytes=peak_memory(),
        device_memory_bytes=torch.cuda.max_memory_allocated() if on_gpu else None,
    )
