"""Options of a training recipe that several commands have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from .shared import chosen_label_settings

if TYPE_CHECKING:
    from ..training.recipe import TrainingOptions

preset_option = click.option(
    "--preset",
    default="default",
    show_default=True,
    help="Recipe that the other options change: default (its values are shown below), paper "
    "(the paper's own), or dense (normal light only, denser labels).",
)
short_sides_option = click.option(
    "--short-side",
    "short_sides",
    type=int,
    multiple=True,
    help="Size of the photographs' shorter side in pixels; may be repeated, validation takes "
    "the first.  "
    "[default: 480 360 240]",
)
augmentations_option = click.option(
    "--augmentations",
    type=int,
    help="Varied views of each photograph at the first size, in normal and in dark light: turned, "
    "relit, blurred, noisy or compressed; each is taken as often as the plain one.  [default: 0]",
)
detectors_option = click.option(
    "--detectors", metavar="NAME,NAME,...", help="Label detectors.  [default: all nine]"
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
    from .._shared.options import replace_options
    from ..training.presets import training_preset

    given = {name: value for name, value in values.items() if value not in (None, ())}
    recipe = training_preset(preset)
    if detectors is not None or label_settings is not None:
        settings = chosen_label_settings(detectors, label_settings)
        given["detectors"], given["label_changes"] = settings.detectors, settings.changes
    if label_settings is None:  # the preset's, as far as its detectors are taken
        chosen = given.get("detectors", recipe.detectors)
        given["label_changes"] = tuple(c for c in recipe.label_changes if c.detector in chosen)
    return replace_options(recipe, **given)
