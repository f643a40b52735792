"""Training the network on a folder of photographs (paper, Section III-B)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from .._shared.errors import OptionError
from .._shared.progress import progress
from ..detector.network.espnet import ESPNet
from ..detector.network.weights import average_weights
from ..detector.pretrained import resolve_weights
from .device import DeviceOptions
from .preparation import Sources, prepare
from .profile import WARM_UP_STEPS, StageProfile, profile_stages
from .recipe import TrainingOptions
from .run import Run, TrainingResult


def train(
    photos: str | Path,
    output: str | Path,
    options: TrainingOptions = TrainingOptions(),
    *,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    init_weights: str | Path | Sequence[str | Path] | None = None,
    device: DeviceOptions = DeviceOptions(),
    workers: int | None = None,
    log: Callable[[str], None] | None = None,
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
        validation: folder of other photographs; default: some are held out.
        labels: folder for the label cache; default: in `output`.
        init_weights: weights (.safetensors) to start from, or "default" or "dense" for those
            inside the package; of several, their mean; default: random ones, by the seed.
        device: how the network is run.
        workers: processes that make labels; default one for each processor.
        log: takes the one line that says how the network is run; without it there is
            no progress bar either.

    Returns:
        The weights' files and the curves.

    Raises:
        ImageError: a folder is missing or empty, or a photograph cannot be read.
        OptionError: the folder holds a run with other options, or the batch normalisation
            or the encoder of random weights is to stay as it is.
        WeightsError: the weights to start from are missing or do not fit.

    Example:
        >>> train("photographs", "run")  # doctest: +SKIP
    """
    options, network = _initial_network(
        options, init_weights
    )  # before the labels, which take minutes
    sources = Sources(Path(photos), Path(output), validation, labels)
    made = prepare(sources, options, workers, quiet=log is None)
    run = Run(made, Path(output), options, device, network, log)
    result = run.fit()
    run.engine.close()
    return result


def profile(
    photos: str | Path,
    output: str | Path,
    options: TrainingOptions = TrainingOptions(),
    *,
    steps: int = 30,
    validation: str | Path | None = None,
    labels: str | Path | None = None,
    init_weights: str | Path | Sequence[str | Path] | None = None,
    device: DeviceOptions = DeviceOptions(),
    workers: int | None = None,
    log: Callable[[str], None] | None = None,
) -> list[StageProfile]:
    """Time some steps of each stage of a run; nothing but the label cache is written.

    Args:
        steps: steps to time in each stage.
        photos, output, options, validation, labels, init_weights, device, workers, log: as of
            `train`.

    Returns:
        One profile a stage.

    Raises:
        The errors of `train`.

    Example:
        >>> profile("photographs", "run")[0].images_per_second  # doctest: +SKIP
    """
    options = dataclasses.replace(options, interleave=False)  # each stage by itself
    options, network = _initial_network(options, init_weights)
    sources = Sources(Path(photos), Path(output), validation, labels)
    made = prepare(sources, options, workers, quiet=log is None)
    run = Run(made, Path(output), options, device, network, resume=False)
    total = sum(min(n, steps + WARM_UP_STEPS) for n in run.schedule.steps_of_stage)
    shown = log is not None and run.place.is_first
    if shown:
        log(f"timing {run.engine.describe()}")
    with progress(total, "timing", "step", not shown) as bar:
        profiles = profile_stages(run.learner, run.batches, steps, bar.update)
    run.engine.close()
    return profiles


def _initial_network(
    options: TrainingOptions, init_weights: str | Path | Sequence[str | Path] | None
) -> tuple[TrainingOptions, ESPNet]:
    """Make the network with the weights that the run starts from, and settle what hangs on them."""
    if init_weights is not None:
        if options.frozen_batch_norm is None:
            options = dataclasses.replace(options, frozen_batch_norm=True)
        chosen = [init_weights] if isinstance(init_weights, (str, Path)) else list(init_weights)
        return options, average_weights([resolve_weights(name, ".safetensors") for name in chosen])
    if options.frozen_batch_norm:
        raise OptionError(
            "random weights have no batch statistics to keep: name trained ones with --init, "
            "or leave out --frozen-batch-norm"
        )
    if options.freeze_encoder:
        raise OptionError(
            "an encoder of random weights would stay random: name trained weights with --init, "
            "or leave out --freeze-encoder"
        )
    torch.manual_seed(options.seed)
    return dataclasses.replace(options, frozen_batch_norm=False), ESPNet()
