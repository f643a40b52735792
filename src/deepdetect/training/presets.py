"""Recipes by name."""

from __future__ import annotations

from .._shared.registry import look_up
from ..labels import LABEL_SETTINGS
from .recipe import Stage, TrainingOptions

PRESETS: dict[str, TrainingOptions] = {
    # Ours: small crops first, evenly scaled photographs of several sizes.
    "default": TrainingOptions(),
    # The paper's (Section III-B): about 33,000 photographs to train on and 8,000 to validate
    # with, squashed to 480x480, a quarter darkened, 100 epochs in batches of 64.
    "paper": TrainingOptions(
        stages=(Stage(480, 64, 100),),
        short_sides=(480,),
        square=True,
        max_photos=41_000,
        val_fraction=8 / 41,
        dark_fraction=0.25,
        transpositions=False,
        color_jitter=0.0,
        learning_rate=1e-3,
        final_learning_rate=1e-6,
        val_count=20,
    ),
    # For two-view geometry (the paper's second weights, Figure 8): normal light only, denser
    # labels. Meant to go on from trained weights, as --init default.
    "dense": TrainingOptions(
        stages=(Stage(480, 8, 5, (480,)), Stage(480, 8, 1, (720,)), Stage(240, 32, 3, (240,))),
        interleave=True,
        short_sides=(480, 240, 720),
        dark_fraction=0.0,
        label_changes=LABEL_SETTINGS["dense"].changes,
        optimizer="soap",
        learning_rate=1.5e-3,
        warm_up=100,
        val_count=6,
    ),
}


def training_preset(name: str) -> TrainingOptions:
    """Look a recipe up by name.

    Raises:
        OptionError: the name is unknown (the nearest right one is named).

    Example:
        >>> training_preset("paper").stages
        (Stage(crop=480, batch=64, epochs=100, sides=()),)
    """
    return look_up("training preset", name, PRESETS)
