"""`deepdetect train`: weights from a folder of images."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    PATH,
    RECIPE,
    chosen_recipe,
    json_option,
    print_json,
    print_table,
    recipe_options,
    workers_option,
)

if TYPE_CHECKING:
    from ..training import StageProfile, TrainingResult

RUN = FieldOptions(
    "training.run:train",
    names=("validation", "labels", "init_weights"),
    flags={"init_weights": "--init"},
    defaults={
        "validation": "one image in twenty is held out",
        "labels": "in the run's folder",
        "init_weights": "random ones, by the seed",
    },
    metavars={"validation": "FOLDER", "labels": "FOLDER", "init_weights": "NAME|FILE"},
)
DEVICE = FieldOptions("training.recipe:DeviceOptions")


@generated_command(RUN, RECIPE, DEVICE, short_help="Train the network on images.")
@click.argument("images", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder of the run.")
@recipe_options
@click.option(
    "--profile",
    "profiling",
    is_flag=True,
    help="Time 30 steps of each stage and report what limits the speed; train nothing.",
)
@workers_option
@json_option
def train(
    images: Path,
    output: Path,
    preset: str,
    detectors: str | None,
    label_settings: str | None,
    profiling: bool,
    workers: int | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Train the network on the images, or the shards, in the folder IMAGES.

    Labels are made first, once, by the detectors of `deepdetect label`. The run's folder gets
    checkpoint.safetensors, best.safetensors and deepdetect.onnx (the weights of the
    lowest validation loss) and the loss curves, curves.csv and curves.png. An interrupted
    run resumes when the same command is given again.

    \b
    deepdetect train photos/ -o run
    deepdetect detect photo.jpg --weights run/deepdetect.onnx
    """
    from ..training.run import require_packages

    require_packages()
    from ..training import DeviceOptions, profile
    from ..training import train as train_network
    from ._records import check_none_made

    check_none_made(images, output)
    arguments = given_only({name: values.pop(name) for name in RUN.names})
    chosen = {name: values.pop(name) for name in DeviceOptions.__dataclass_fields__}
    arguments["device"] = DeviceOptions(**given_only(chosen))
    arguments |= {"workers": workers, "log": None if as_json else click.echo}
    options = chosen_recipe(preset, detectors, label_settings, values)
    if profiling:
        _print_profiles(profile(images, output, options, **arguments), as_json)
    else:
        _print_result(train_network(images, output, options, **arguments), as_json)


def _is_main_process() -> bool:
    return int(os.environ.get("RANK", 0)) == 0  # of torchrun


def _print_result(result: TrainingResult, as_json: bool) -> None:
    if not _is_main_process():
        return
    best = result.best
    if as_json:
        print_json(
            {
                "weights": result.weights,
                "onnx": result.onnx,
                "epoch": best["epoch"],
                "validation_loss": best["validation_loss"],
                "normal": {"loss": best["normal_loss"], "iou": best["normal_iou"]},
                "dark": {"loss": best["dark_loss"], "iou": best["dark_iou"]},
                "images_per_second": round(result.images_per_second, 3),
            }
        )
        return
    print_table(
        [
            ("best after epoch", f"{best['epoch']:.1f}"),
            ("validation loss", f"{best['validation_loss']:.4f}"),
            ("normal images", f"loss {best['normal_loss']:.4f}, IoU {best['normal_iou']:.3f}"),
            ("dark images", f"loss {best['dark_loss']:.4f}, IoU {best['dark_iou']:.3f}"),
            ("480x480 images/s", f"{result.images_per_second:.1f}"),
            ("written", f"{result.weights}, {result.onnx}"),
        ]
    )


def _print_profiles(profiles: list[StageProfile], as_json: bool) -> None:
    from dataclasses import asdict

    if not _is_main_process():
        return
    if as_json:
        print_json([asdict(profile) for profile in profiles])
        return
    for profile in profiles:
        rows = [
            ("steps timed", f"{profile.steps}"),
            ("crops/s", f"{profile.images_per_second:.1f}"),
            ("480x480 images/s", f"{profile.full_images_per_second:.1f}"),
            ("waiting for data", f"{100 * profile.waiting_fraction:.1f} %"),
        ]
        if profile.memory_bytes is not None:
            rows.append(("peak memory", f"{profile.memory_bytes / 1e9:.2f} GB"))
        if profile.device_memory_bytes is not None:
            rows.append(("peak GPU memory", f"{profile.device_memory_bytes / 1e9:.2f} GB"))
        stage = profile.stage
        print_table(rows, f"{stage.batch} crops of {stage.crop}x{stage.crop} pixels per step")
