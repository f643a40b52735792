"""Options of labels and recipes, which several commands share."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from cyclopts import Parameter

from ..labels import LabelOptions, find_label_settings
from ..training import Stage, TrainingOptions, training_preset
from ._options import From

Detectors = Annotated[
    str | None,
    Parameter(
        help="Some of sift, orb, brisk, fast, agast, harris, shi-tomasi, canny, sobel, with commas "
        "between.  [default: all]"
    ),
]
LabelSettings = Annotated[
    str | None,
    Parameter(help="Detectors and their settings: paper or dense, or a file.  [default: paper]"),
]
Preset = Annotated[
    str,
    Parameter(
        help="Recipe that the other options change: default (its values are shown here), paper "
        "(the paper's own), or dense (normal light only, denser labels)."
    ),
]

RECIPE = From(
    TrainingOptions,
    " ".join(n for n in TrainingOptions.__dataclass_fields__ if n != "labels"),
    common="stages max_images learning_rate augmentations seed",
    flags={
        "stages": "--stage",
        "short_sides": "--short-side",
        "frozen_batch_norm": "--frozen-batch-norm/--batch-norm",
    },
    types={"stages": list[str] | None, "short_sides": list[int] | None},
    defaults={
        "stages": "240x16x44 480x8x10",
        "short_sides": "480 360 240",
        "max_images": "all",
        "frozen_batch_norm": "with --init",
        "low_light_pos_weight": "that of --pos-weight",
    },
)
SHARDS = replace(RECIPE, names="short_sides square max_images val_fraction augmentations")
"""What of a recipe is fixed once the labels are made."""


def chosen_label_settings(detectors: str | None, chosen: str | None) -> LabelOptions:
    """Find settings by name or TOML file; detectors (with commas between) replace theirs."""
    settings = find_label_settings("paper" if chosen is None else chosen)
    if detectors is None:
        return settings
    names = tuple(name.strip() for name in detectors.split(",") if name.strip())
    return replace(settings, detectors=names)


def chosen_recipe(
    preset: str, detectors: str | None, label_settings: str | None, values: dict[str, Any]
) -> TrainingOptions:
    """Return a preset's training options with the given values changed."""
    if "stages" in values:
        values["stages"] = tuple(map(Stage.parse, values["stages"]))
    if "short_sides" in values:
        values["short_sides"] = tuple(values["short_sides"])
    recipe = training_preset(preset)
    if label_settings is not None:
        values["labels"] = chosen_label_settings(detectors, label_settings)
    elif detectors is not None:  # the preset's settings, for the detectors that are used
        chosen = chosen_label_settings(detectors, None).detectors
        values["labels"] = recipe.labels.with_detectors(chosen)
    return replace(recipe, **values)
