"""Options of a training recipe that several commands have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from ._generated import FieldOptions, given_only
from .shared import chosen_label_settings, combined, label_settings_option

if TYPE_CHECKING:
    from ..training import TrainingOptions

RECIPE = FieldOptions(
    "training.recipe:TrainingOptions",
    skip=("darkening", "detectors", "label_changes"),
    flags={
        "stages": "--stage",
        "short_sides": "--short-side",
        "frozen_batch_norm": "--frozen-batch-norm/--batch-norm",
    },
    metavars={"stages": "CROPxBATCHxEPOCHS[@SIDE,...]"},
    defaults={
        "stages": "240x16x44 480x8x10",
        "max_images": "all",
        "frozen_batch_norm": "with --init",
        "low_light_pos_weight": "that of --pos-weight",
    },
)

SHARDS = FieldOptions(
    RECIPE.path,
    names=("short_sides", "square", "max_images", "val_fraction", "dark_variants", "augmentations"),
    flags=RECIPE.flags,
    defaults=RECIPE.defaults,
)
"""What of a recipe is fixed once the labels are made."""

recipe_options = combined(
    click.option(
        "--preset",
        default="default",
        show_default=True,
        help="Recipe that the other options change: default (its values are shown here), paper "
        "(the paper's own), or dense (normal light only, denser labels).",
    ),
    click.option(
        "--detectors", metavar="NAME,NAME,...", help="Label detectors.  [default: all nine]"
    ),
    label_settings_option,
)


def chosen_recipe(
    preset: str, detectors: str | None, label_settings: str | None, values: dict[str, Any]
) -> TrainingOptions:
    """Return a preset's training options with the values that are given changed.

    Args:
        preset: its name.
        detectors, label_settings: as of `chosen_label_settings`.
        values: the others, by name; None and () stand for what is not given.
    """
    import dataclasses

    from ..training import Stage, training_preset

    given = given_only(values)
    if "stages" in given:
        given["stages"] = tuple(
            Stage.parse(stage) if isinstance(stage, str) else stage for stage in given["stages"]
        )
    recipe = training_preset(preset)
    if detectors is not None or label_settings is not None:
        settings = chosen_label_settings(detectors, label_settings)
        given["detectors"], given["label_changes"] = settings.detectors, settings.changes
    if label_settings is None:  # the preset's, for the detectors that are used
        chosen = given.get("detectors", recipe.detectors)
        given["label_changes"] = tuple(c for c in recipe.label_changes if c.detector in chosen)
    return dataclasses.replace(recipe, **given)
