"""Train networks. The functions import torch only when called, so other commands start faster."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from deepdetect._shared.errors import OptionError
from deepdetect._shared.options import suggest_keywords
from deepdetect.io.image import find_images

from .recipe import (
    DescriptorTrainingOptions,
    DeviceOptions,
    InitWeights,
    MatcherTrainingOptions,
    MatchFilterTrainingOptions,
    PointsTrainingOptions,
    TrainingOptions,
)

if TYPE_CHECKING:
    from .trainer import Trainer, TrainingResult

Log = Callable[[str], None]
PairOptions = (
    PointsTrainingOptions
    | DescriptorTrainingOptions
    | MatchFilterTrainingOptions
    | MatcherTrainingOptions
)


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
    """Train the detector network on a folder of images.

    An interrupted run resumes from its last checkpoint if started again with the same options; the
    result is the same as without interruption. Labels are made in other processes, so a script must
    call this under `if __name__ == "__main__":`.

    Args:
        images: folder of images.
        output: folder for checkpoint.safetensors, best.safetensors, deepdetect.onnx,
            MODEL_CARD.md and the loss curves.
        options: the recipe.
        validation: folder of other images for validation. None: some of `images` are held out.
        labels: folder in which labels are cached. None: a folder in `output`.
        init_weights: .safetensors files or bundled weights ("default", "dense", "free", "espnet")
            to start from; several are averaged. None: random weights from the seed.
        device: device, precision, compilation and processes.
        workers: number of processes that make labels. None: one per processor.
        log: function that gets each line of text for the user. None: no text, and no progress bars.

    Returns:
        The files of the weights, and the loss curves.

    Raises:
        ImageError: a folder is missing or empty.
        OptionError: `output` holds a run with other options, the initial weights belong to another
            network, or `frozen_batch_norm` is set without trained initial weights.
        WeightsError: the initial weights are missing or do not fit.
        DeepDetectError: an image cannot be read.

    Example:
        >>> from deepdetect_lab.training import Stage
        >>> options = TrainingOptions(stages=(Stage(crop=480, batch=16, epochs=20),), seed=1)
        >>> result = train("photos", "run", options)  # doctest: +SKIP
        >>> detector = DeepDetect(result.onnx)  # doctest: +SKIP
    """
    from .dataset import prepare_data
    from .dense import DenseTrainer, initial_network

    options, network = initial_network(options, init_weights)  # fails before labels are made
    data = prepare_data(
        images,
        options,
        output,
        validation=validation,
        labels=labels,
        workers=workers,
        processes=max(1, device.worker_count),
        quiet=log is None,
    )
    return DenseTrainer(network, options, data, device).fit(Path(output), log)


@suggest_keywords
def train_on_pairs(
    images: str | Path,
    validation: str | Path,
    output: str | Path,
    options: PairOptions,
    *,
    init_weights: str | Path | None = None,
    readings: str | Path | None = None,
    places: str | Path | None = None,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    num_workers: int | None = None,
    log: Log | None = None,
) -> TrainingResult:
    """Train a network on pairs of synthetic views of single images.

    The class of `options` chooses the network: the keypoint ranker, the learned descriptor, the
    matcher, or the match filter. A match filter takes a quarter of an hour on two processors. An
    interrupted run resumes as in `train`.

    Args:
        images: folder of images, ideally with sides of about 480 pixels.
        validation: folder of other images, by which the best weights are chosen.
        output: folder for checkpoint.safetensors, the best weights (best.npz for a ranker, a
            safetensors and an ONNX file otherwise), MODEL_CARD.md and the training curves.
        options: the recipe.
        init_weights: weights to start from, for a descriptor or a matcher: a safetensors file that
            a run wrote; for a descriptor also EdgePoint2's L64.pth. None: random, from the seed.
        readings: folder written by `deepdetect dev read-teachers`, for a descriptor with `crops`.
        places: folder of real photographs for a matcher, with the folders `fixed` and `moving`.
            Each has a folder per place, with photographs of a fixed camera, or from several
            viewpoints.
        device: "auto" is CUDA if there is a GPU, else the CPU. Only descriptors can use a GPU.
        num_workers: number of processes that generate pairs; with 0, the training process does it.
            None: 0, or for a descriptor on a GPU, one less than the number of processors. Both
            matchers always draw on all processors.
        log: function that gets each line of text for the user. None: no text, and no progress bars.

    Returns:
        The files of the weights, and the training curves. `PointDetector` reads the weights of
        rankers and descriptors.

    Raises:
        ImageError: a folder is missing or empty.
        OptionError: `output` holds a run with other options or images, the images have too little
            detail, or `options.crops` is not 0 but `readings` is None.
        WeightsError: the initial weights are missing or do not fit.

    Example:
        >>> from deepdetect_lab.training import DescriptorTrainingOptions
        >>> options = DescriptorTrainingOptions(steps=400)
        >>> result = train_on_pairs("photos/train", "photos/val", "run", options)  # doctest: +SKIP
        >>> PointDetector(descriptor=result.onnx).extract("a.png")  # doctest: +SKIP
    """
    where = DeviceOptions(device=device, num_workers=num_workers)
    files = _files(images, validation, output)
    trainer: Trainer
    if isinstance(options, DescriptorTrainingOptions):
        from .descriptor.task import DescriptorTrainer

        if options.crops and readings is None:
            raise OptionError("`crops` need `readings`, the folder that `read-teachers` wrote")
        of_teachers = Path(readings) if readings is not None and options.crops else None
        trainer = DescriptorTrainer(*files, options, init_weights, where, of_teachers)
    elif isinstance(options, PointsTrainingOptions):
        from .points.task import RankerTrainer

        trainer = RankerTrainer(*files, options, num_workers or 0)
    elif isinstance(options, MatcherTrainingOptions):
        from .matcher.task import MatcherTrainer

        where_taken = None if places is None else Path(places)
        trainer = MatcherTrainer(
            *files, options, Path(output), where_taken, init_weights, log is None
        )
    else:
        from .match_filter import MatchFilterTrainer

        trainer = MatchFilterTrainer(*files, options, log is None)
    return trainer.fit(Path(output), log)


def _files(
    images: str | Path, validation: str | Path, output: str | Path
) -> tuple[list[Path], list[Path]]:
    """List training and validation images, without the figures that runs write to `output`."""
    images, validation, output = Path(images), Path(validation), Path(output)
    return find_images(images, [output, validation]), find_images(validation, [output, images])
