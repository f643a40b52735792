"""`deepdetect train`: weights from a folder of photographs."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .cluster import ending_all_processes
from .recipe import (
    augmentations_option,
    chosen_recipe,
    detectors_option,
    preset_option,
    short_sides_option,
)
from .shared import (
    PATH,
    json_option,
    label_settings_option,
    print_json,
    print_table,
    workers_option,
)

if TYPE_CHECKING:
    from ..training.profile import StageProfile
    from ..training.run import TrainingResult


@click.command(short_help="Train the network on photographs.")
@click.argument("photos", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder of the run.")
@preset_option
@click.option(
    "--validation",
    type=PATH,
    help="Folder of other photographs.  [default: one in twenty is held out]",
)
@click.option("--labels", type=PATH, help="Folder for the label cache.  [default: in the run's]")
@click.option(
    "--init",
    "init_weights",
    multiple=True,
    metavar="NAME|FILE",
    help="Weights to start from: default or dense, the bundled ones, or a .safetensors "
    "file; repeated, the mean of all.  [default: random ones]",
)
@click.option(
    "--stage",
    "stages",
    multiple=True,
    metavar="CROPxBATCHxEPOCHS[@SIDE,...]",
    help="What is trained on, if you like with views of some short sides only; repeat it for "
    "several in turn.  [default: 240x16x44 480x8x10]",
)
@click.option(
    "--interleave/--in-turn",
    default=None,
    help="Mix the stages' steps evenly.  [default: in turn]",
)
@short_sides_option
@click.option("--dark-fraction", type=float, help="Share of darkened images.  [default: 0.25]")
@augmentations_option
@click.option(
    "--flips/--no-flips",
    default=None,
    help="Mirror crops left to right and upside down, too, where labels fit less.  [default: no]",
)
@click.option(
    "--transpositions/--no-transpositions",
    default=None,
    help="Mirror crops along their diagonal, where labels are the same.  [default: yes]",
)
@click.option(
    "--color-jitter",
    type=float,
    help="Share of crops with other colours of the same luma.  [default: 0.5]",
)
@click.option("--optimizer", help="adam or soap.  [default: adam]")
@click.option("--learning-rate", type=float, help="At the start.  [default: 0.001]")
@click.option("--warm-up", type=int, help="Steps to that rate.  [default: 0]")
@click.option(
    "--frozen-batch-norm/--batch-norm",
    default=None,
    help="Keep the start weights' batch statistics.  [default: with --start]",
)
@click.option(
    "--pos-weight",
    type=float,
    help="Weight of marked pixels in the loss: above 1 gives more keypoints.  [default: 1]",
)
@click.option(
    "--low-light-pos-weight",
    type=float,
    help="The same in crops of low visibility.  [default: that of all others]",
)
@click.option(
    "--pos-weight-uncertain/--pos-weight-all",
    default=None,
    help="These weights only where the network is not sure.  [default: wherever it is]",
)
@click.option(
    "--freeze-encoder/--train-encoder",
    default=None,
    help="Train the decoder only; the encoder stays as it is.  [default: train both]",
)
@detectors_option
@label_settings_option
@click.option("--val-count", type=int, help="How often the loss is validated.  [default: 12]")
@click.option("--seed", type=int, help="Of all random choices.  [default: 0]")
@click.option("--device", default="auto", show_default=True, help="cpu, cuda or auto.")
@click.option(
    "--precision", default="auto", show_default=True, help="float32, bfloat16 or auto (fastest)."
)
@click.option(
    "--compile/--no-compile",
    "compile_network",
    default=None,
    help="torch.compile.  [default: when there is a C++ compiler]",
)
@click.option("--threads", type=int, help="CPU threads.  [default: torch's choice]")
@click.option(
    "--num-workers",
    type=int,
    help="Threads that make batches.  [default: 1 beside a CPU that trains, else all but one]",
)
@click.option(
    "--profile",
    "timed",
    is_flag=True,
    help="Time 30 steps of each stage and say what holds them back; train nothing.",
)
@workers_option
@json_option
def train(
    photos: Path,
    output: Path,
    validation: Path | None,
    labels: Path | None,
    init_weights: tuple[str, ...],
    device: str,
    precision: str,
    compile_network: bool | None,
    threads: int | None,
    num_workers: int | None,
    timed: bool,
    preset: str,
    detectors: str | None,
    label_settings: str | None,
    workers: int | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Train the network on the photographs, or the shards, in the folder PHOTOS.

    Labels are made first, once, by `deepdetect label`'s detectors. The run's folder gets
    checkpoint.safetensors, best.safetensors and deepdetect.onnx (the weights of the
    lowest validation loss) and the loss curves, curves.csv and curves.png. A run that was
    broken off goes on when the same command is given again.

    \b
    deepdetect train photos/ -o run
    deepdetect detect photo.jpg --weights run/deepdetect.onnx
    """
    from .._shared.errors import MissingExtraError

    for package in ("torch", "lightning_fabric", "safetensors", "onnx"):
        if importlib.util.find_spec(package) is None:
            raise MissingExtraError(
                f"training needs the package {package.replace('_', '-')}, which is not installed: "
                "run pip install torch lightning-fabric safetensors onnx matplotlib"
            )
    from ..training import trainer
    from ..training.device import DeviceOptions
    from ..training.recipe import Stage

    values["stages"] = tuple(Stage.parse(text) for text in values["stages"])
    arguments = {
        "validation": validation,
        "labels": labels,
        "init_weights": init_weights or None,
        "device": DeviceOptions(device, precision, compile_network, threads, num_workers),
        "workers": workers,
        "log": None if as_json else click.echo,
    }
    options = chosen_recipe(preset, detectors, label_settings, values)
    with ending_all_processes():
        if timed:
            _print_profiles(trainer.profile(photos, output, options, **arguments), as_json)
            return
        _print_result(trainer.train(photos, output, options, **arguments), as_json)


def _print_result(result: TrainingResult, as_json: bool) -> None:
    from ..training.cluster import distributed_context

    if not distributed_context().is_first:
        return
    best = result.best
    if as_json:
        print_json(
            {
                "weights": result.weights,
                "onnx": result.onnx,
                "epoch": best.epoch,
                "validation_loss": best.validation_loss,
                "normal": {"loss": best.normal_loss, "iou": best.normal_iou},
                "dark": {"loss": best.dark_loss, "iou": best.dark_iou},
                "images_per_second": round(result.images_per_second, 3),
            }
        )
        return
    print_table(
        [
            ("best after epoch", f"{best.epoch:.1f}"),
            ("validation loss", f"{best.validation_loss:.4f}"),
            ("normal images", f"loss {best.normal_loss:.4f}, IoU {best.normal_iou:.3f}"),
            ("dark images", f"loss {best.dark_loss:.4f}, IoU {best.dark_iou:.3f}"),
            ("480x480 images/s", f"{result.images_per_second:.1f}"),
            ("written", f"{result.weights}, {result.onnx}"),
        ]
    )


def _print_profiles(profiles: list[StageProfile], as_json: bool) -> None:
    from dataclasses import asdict

    from ..training.cluster import distributed_context

    if not distributed_context().is_first:
        return
    if as_json:
        print_json([asdict(profile) for profile in profiles])
        return
    for profile in profiles:
        rows = [
            ("steps timed", f"{profile.steps}"),
            ("crops/s", f"{profile.images_per_second:.1f}"),
            ("480x480 images/s", f"{profile.full_images_per_second:.1f}"),
            ("waiting for data", f"{100 * profile.waiting_share:.1f} %"),
        ]
        if profile.memory is not None:
            rows.append(("peak memory", f"{profile.memory / 1e9:.2f} GB"))
        if profile.device_memory is not None:
            rows.append(("peak GPU memory", f"{profile.device_memory / 1e9:.2f} GB"))
        stage = profile.stage
        print_table(rows, f"{stage.batch} crops of {stage.crop}x{stage.crop} pixels a step")
