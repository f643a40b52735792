"""`deepdetect train`: weights from a folder of images."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..training import DeviceOptions, profile
from ..training import train as train_network
from ..training.run import require_packages
from . import _options as cli
from ._training import RECIPE, Detectors, LabelSettings, Preset, chosen_recipe

RUN = cli.From(
    train_network,
    "validation labels init_weights",
    common="validation init_weights",
    flags={"init_weights": "--init"},
    types={"init_weights": list[str] | None},
    defaults={
        "validation": "one image in twenty is held out",
        "labels": "in the run's folder",
        "init_weights": "random ones, by the seed",
    },
)
DEVICE = cli.From(DeviceOptions, common="device")


@cli.with_options(RUN, RECIPE, DEVICE)
def train(
    images: Annotated[Path, Parameter(help="Folder of images, or of shards.")],
    /,
    *,
    output: cli.Output,
    preset: Preset = "default",
    detectors: Detectors = None,
    label_settings: LabelSettings = None,
    profiling: Annotated[bool, Parameter("--profile", negative="")] = False,
    workers: cli.Workers = None,
    as_json: cli.Json = False,
    **values: Any,
) -> None:
    """Train the network on the images, or the shards, in a folder.

    Labels are made first, once, by the detectors of `deepdetect label`. The run's folder gets
    checkpoint.safetensors, best.safetensors and deepdetect.onnx (the weights of the lowest
    validation loss) and the loss curves, curves.csv and curves.png. An interrupted run resumes when
    the same command is given again.

        deepdetect train photos/ -o run
        deepdetect detect photo.jpg --weights run/deepdetect.onnx

    Args:
        output: Folder of the run.
        profiling: Time 30 steps of each stage and report what limits the speed; train nothing.
    """
    require_packages()
    cli.check_folder_not_made(images, output)
    arguments = RUN.take(values)
    if given := arguments.pop("init_weights", None):
        arguments["init_weights"] = given[0] if len(given) == 1 else tuple(given)
    arguments["device"] = DeviceOptions(**DEVICE.take(values))
    arguments |= {"workers": workers, "log": None if as_json else print}
    options = chosen_recipe(preset, detectors, label_settings, values)
    if profiling:
        profiles = profile(images, output, options, **arguments)
        if int(os.environ.get("RANK", 0)) == 0:  # of torchrun
            if as_json:
                cli.print_json([asdict(each) for each in profiles])
            for each in () if as_json else profiles:
                cli.print_result(False, asdict(each))
        return
    result = train_network(images, output, options, **arguments)
    if int(os.environ.get("RANK", 0)) == 0:
        best = result.best
        values = {
            "weights": result.weights,
            "onnx": result.onnx,
            "epoch": best["epoch"],
            "validation_loss": best["validation_loss"],
            "normal": {"loss": best["normal_loss"], "iou": best["normal_iou"]},
            "dark": {"loss": best["dark_loss"], "iou": best["dark_iou"]},
            "images_per_second": round(result.images_per_second, 3),
        }
        cli.print_result(as_json, values)
