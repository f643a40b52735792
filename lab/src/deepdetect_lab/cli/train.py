"""Commands that train networks, label images and average weights."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from deepdetect._shared.machine import map_in_processes
from deepdetect._shared.options import look_up
from deepdetect._shared.progress import progress
from deepdetect.cli import _options as cli

from ..evaluation.provenance import provenance
from ..labels import LabelOptions, find_label_settings
from ..labels.fusion import LabelTask, label_file
from ..training import (
    PRESETS,
    DescriptorTrainingOptions,
    DeviceOptions,
    MatcherTrainingOptions,
    MatchFilterTrainingOptions,
    PointsTrainingOptions,
    Stage,
    TrainingOptions,
)
from ..training import train as train_network
from ..training import train_on_pairs as train_network_on_pairs
from ..training.run import PairOptions

Folder = Annotated[Path, Parameter(help="Folder of images.")]
RUN = cli.From(
    train_network,
    "validation init_weights",
    more="labels workers",
    flags={"init_weights": "--init"},
    types={"init_weights": list[str] | None},
    defaults={
        "validation": "one image in twenty is held out",
        "labels": "in the output folder",
        "init_weights": "random, by the seed",
    },
)
RECIPE = cli.From(
    TrainingOptions,
    "stages max_images learning_rate augmentations seed",
    more=" ".join(n for n in TrainingOptions.__dataclass_fields__ if n != "labels"),
    flags={
        "stages": "--stage",
        "short_sides": "--short-side",
        "frozen_batch_norm": "--frozen-batch-norm/--batch-norm",
    },
    types={"stages": list[str] | None},
    defaults={
        "stages": "480x16x40@480 240x64x36@240 352x30x16@352 960x4x2@960",
        "short_sides": "480 240 352 960",
        "max_images": "all",
        "frozen_batch_norm": "with --init",
        "low_light_pos_weight": "that of --pos-weight",
    },
)
DEVICE = cli.From(DeviceOptions, "device")
PAIRS_RUN = cli.From(
    train_network_on_pairs,
    "validation init_weights readings places device num_workers",
    more="",
    flags={"init_weights": "--init"},
    types={
        "validation": Path,
        "init_weights": Path | None,
        "readings": Path | None,
        "places": Path | None,
    },
    defaults={"init_weights": "random, by the seed", "num_workers": "0 on a CPU"},
)
DESCRIPTOR_RUN = replace(PAIRS_RUN, common="validation init_weights readings device num_workers")
MATCHER_RUN = replace(PAIRS_RUN, common="validation init_weights places")
WORKERS_RUN = replace(PAIRS_RUN, common="validation num_workers")
FILTER_RUN = replace(PAIRS_RUN, common="validation")


def chosen_label_settings(
    detectors: str | None = None, label_settings: str | None = None
) -> LabelOptions:
    """Return label settings by name or TOML file; `detectors` replace the detectors in them.

    Args:
        detectors: Detectors, separated by commas: sift, orb, brisk, fast, agast, harris,
            shi-tomasi, canny, sobel.  [default: all]
        label_settings: Detectors and their settings: paper, dense, or a TOML file.
            [default: paper]
    """
    settings = find_label_settings(label_settings or "paper")
    if detectors is None:
        return settings
    names = tuple(name.strip() for name in detectors.split(",") if name.strip())
    return settings.with_detectors(names)


def chosen_recipe(
    preset: str = "default",
    detectors: str | None = None,
    label_settings: str | None = None,
    **values: Any,
) -> TrainingOptions:
    """Return a preset's training options with the given values changed.

    Args:
        preset: Recipe: default (its values are shown here), dense (normal light only, denser
            labels), espnet (trains ESPNet), or paper (trains ESPNet as in the paper); other options
            override its values.
    """
    if "stages" in values:
        values["stages"] = tuple(map(Stage.parse, values["stages"]))
    recipe = look_up("training preset", preset, PRESETS)
    labels = chosen_label_settings(detectors, label_settings)
    if label_settings is not None:
        values["labels"] = labels
    elif detectors is not None:  # keeps the preset's settings of detectors
        values["labels"] = recipe.labels.with_detectors(labels.detectors)
    return replace(recipe, **values)


PRESET = cli.From(chosen_recipe, "preset", more="")
LABELS = cli.From(chosen_label_settings, "detectors label_settings")


@cli.command(PRESET, LABELS, RUN, RECIPE, DEVICE)
def train(
    images: Folder,
    /,
    *,
    output: cli.Output,
    **values: Any,
) -> cli.Result:
    """Train the network on the images in a folder.

    First, the detectors of `deepdetect label` make the labels. The output folder gets the weights
    with the lowest validation loss (best.safetensors, deepdetect.onnx), the loss curves
    (curves.csv, curves.png), and checkpoint.safetensors, from which the command resumes.

        deepdetect train photos/ -o run
        deepdetect detect photo.jpg --weights run/deepdetect.onnx

    Args:
        output: Folder of the run.
    """
    run = RUN.take(values)
    if given := run.pop("init_weights", None):
        run["init_weights"] = given[0] if len(given) == 1 else tuple(given)
    run |= {"device": DeviceOptions(**DEVICE.take(values)), "log": cli.say}
    recipe = chosen_recipe(**values)
    result = train_network(images, output, recipe, **run)
    best = result.best
    return cli.Result(
        {
            "weights": result.weights,
            "onnx": result.onnx,
            "epoch": best["epoch"],
            "validation_loss": best["validation_loss"],
            "normal": {"loss": best["normal_loss"], "iou": best["normal_iou"]},
            "dark": {"loss": best["dark_loss"], "iou": best["dark_iou"]},
        }
    )


def _train_on_pairs(
    images: Path, output: Path, make_options: Callable[..., PairOptions], values: dict[str, Any]
) -> cli.Result:
    run = {**PAIRS_RUN.take(values), "log": cli.say}
    result = train_network_on_pairs(images, output=output, options=make_options(**values), **run)
    files = {"weights": result.weights, "onnx": result.onnx}
    return cli.Result({**files, "best": result.best, "points": result.points})


@cli.command(WORKERS_RUN, cli.From(PointsTrainingOptions, "steps seed"))
def train_points(images: Folder, /, *, output: cli.Output, **values: Any) -> cli.Result:
    """Train the ranker of keypoints on the images in a folder.

    Needs no labels: it makes pairs of synthetic views from single images. Writes best.npz,
    MODEL_CARD.md, training curves, and a checkpoint from which the same command resumes.

        deepdetect dev train-points photos/train --validation photos/val -o run

    Args:
        output: Folder of the run.
    """
    return _train_on_pairs(images, output, PointsTrainingOptions, values)


@cli.command(DESCRIPTOR_RUN, cli.From(DescriptorTrainingOptions, "steps pairs seed"))
def train_descriptor(images: Folder, /, *, output: cli.Output, **values: Any) -> cli.Result:
    """Train the learned descriptor of keypoints on the images in a folder.

    Needs no labels: it makes pairs of synthetic views from single images. Writes descriptor.onnx,
    descriptor.safetensors, MODEL_CARD.md, training curves, and a checkpoint from which the same
    command resumes an interrupted run.

        deepdetect train-descriptor photos/train --validation photos/val -o run

    Args:
        output: Folder of the run.
    """
    return _train_on_pairs(images, output, DescriptorTrainingOptions, values)


@cli.command()
def read_teachers(
    *images: cli.Images, output: cli.Output, edgepoint: Path, aliked: Path
) -> cli.Result:
    """Compute two published descriptors at points of photographs, to train our own on them.

    Writes one file per photograph, from which `train-descriptor --crops 6 --readings FOLDER`
    learns. To resume, run the command again.

        deepdetect dev read-teachers photos/train photos/val -o readings --edgepoint e64.onnx
            --aliked aliked-n16rot.pth

    Args:
        output: Folder for the readings.
        edgepoint: ONNX file of EdgePoint2-E64 (MIT), from image to scores and descriptors.
        aliked: The authors' weights file of ALIKED-n16rot (BSD-3-Clause).
    """
    from ..training.teachers.readings import Teachers, write_readings

    folder = cli.output_folder(output)
    files = list(cli.expand_images(images, folder).values())
    made = list(write_readings(files, folder, Teachers(edgepoint, aliked), quiet=False))
    counts = {"read": len(made), "skipped": len(files) - len(made), "points": sum(made)}
    return cli.Result({"folder": folder, **counts})


@cli.command(FILTER_RUN, cli.From(MatchFilterTrainingOptions, "steps drawn val_pairs seed"))
def train_match_filter(images: Folder, /, *, output: cli.Output, **values: Any) -> cli.Result:
    """Train the network that separates correct matches from wrong ones by their neighbours.

    Needs no labels: it makes pairs of synthetic views from single images. Writes match_filter.onnx,
    match_filter.safetensors, MODEL_CARD.md, training curves, and a checkpoint from which the same
    command resumes an interrupted run.

        deepdetect dev train-match-filter photos/train --validation photos/val -o run

    Args:
        output: Folder of the run.
    """
    return _train_on_pairs(images, output, MatchFilterTrainingOptions, values)


@cli.command(MATCHER_RUN, cli.From(MatcherTrainingOptions, "steps drawn learning_rate seed"))
def train_matcher(images: Folder, /, *, output: cli.Output, **values: Any) -> cli.Result:
    """Train the network that matches keypoints by attention.

    Makes pairs of synthetic views from single images, and pairs of photographs of places if there
    are any: PLACES/fixed/NAME/ has photographs of a fixed camera, PLACES/moving/NAME/ photographs
    from several viewpoints. Writes attention.onnx, attention.safetensors, MODEL_CARD.md, training
    curves, the pairs, and a checkpoint from which the same command resumes an interrupted run.

        deepdetect dev train-matcher photos/train --validation photos/val -o run

    Args:
        output: Folder of the run.
    """
    return _train_on_pairs(images, output, MatcherTrainingOptions, values)


@cli.command(LABELS, cli.From(LabelOptions, "visibility", more=""))
def label(
    *images: cli.Images,
    output: cli.Output,
    visualize: bool = False,
    overwrite: cli.Overwrite = False,
    workers: cli.More[int | None] = None,
    **values: Any,
) -> cli.Result:
    """Mark the keypoints and edges of images (files or folders) by nine classical detectors.

    Writes a 1-bit PNG mask STEM.png for each image: white where a detector marks the pixel.
    Existing masks of unchanged images are skipped. Masks of another image or of other settings are
    only replaced with --overwrite.

        deepdetect label photos/ -o masks
        deepdetect label photo.jpg -o masks --detectors fast,sobel --visualize

    Args:
        output: Folder for the masks.
        visualize: Also write STEM_labels.png, a figure of the image and its masks.
        workers: Number of processes.  [default: one per processor]
    """
    folder = cli.output_folder(output)
    options = replace(chosen_label_settings(**LABELS.take(values)), **values)
    tasks = []
    for image, stem in cli.result_stems(cli.expand_images(images, folder)).items():
        figure = folder / f"{stem}_labels.png" if visualize else None
        tasks.append(LabelTask(image, folder / f"{stem}.png", options, figure, overwrite))
    cli.check_outputs(
        [path for task in tasks for path in task.outputs.paths], [task.image for task in tasks]
    )
    left = [task for task in tasks if task.outputs.find() is None]
    done: list[dict[str, Any]] = []
    failures: list[str] = []
    with progress(len(left), "labelling", "image") as bar:
        for report in map_in_processes(label_file, left, workers):
            of_kind: list[Any] = failures if isinstance(report, str) else done
            of_kind.append(report)
            bar.update(1)
    done.sort(key=lambda report: str(report["image"]))
    skipped = len(tasks) - len(left)
    found = {
        "labelled": done,
        "skipped": skipped,
        "mean_density": sum(each["density"] for each in done) / len(done) if done else None,
        "failures": failures,
    }
    text = f"{len(done)} labelled, {skipped} already done"
    if done:
        low = sum(each["visibility"] == "low" for each in done)
        text += f"; mean density {found['mean_density']:.3f}, {low} of low visibility"
    return cli.Result(found, f"{text} -> {folder}", failures, len(tasks))


@cli.command()
def average(
    *weights: Annotated[
        str,
        Parameter(
            help=".safetensors files, or default, dense, free or espnet; repeat one to count it "
            "twice.",
            required=True,
        ),
    ],
    output: cli.Output,
    overwrite: cli.Overwrite = False,
) -> cli.Result:
    """Average weights (a model soup) into best.safetensors and deepdetect.onnx.

    The mean of the weights of successive runs often scores better than any run. A single file is
    only converted to ONNX. Files of another average are only replaced with --overwrite.

        deepdetect dev average first/best.safetensors second/best.safetensors -o mean
        deepdetect dev evaluate samples/ --weights mean/deepdetect.onnx

    Args:
        output: Folder for the two files.
    """
    folder = cli.output_folder(output)
    files = {"weights": folder / "best.safetensors", "onnx": folder / "deepdetect.onnx"}

    from ..networks.export import export_onnx
    from ..networks.weights import (
        average_weights,
        find_weights,
        load_network,
        read_notes,
        save_tensors,
        weights_digest,
    )

    paths = [find_weights(name) for name in weights]
    with cli.writing(files, paths, overwrite) as made:
        network = average_weights(paths)
        parts = [{"sha256": weights_digest(load_network(p)), **read_notes(p)} for p in paths]
        save_tensors(
            network.state_dict(), made["weights"], {"parts": json.dumps(parts), **provenance()}
        )
        export_onnx(network, made["onnx"])
    return cli.Result(files)
