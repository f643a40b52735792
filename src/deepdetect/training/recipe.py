"""What a training run does: all its options."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field

from .._shared.errors import OptionError
from .._shared.registry import look_up
from ..labels import DETECTOR_NAMES, LabelOptions, SettingChange
from .darkening import DarkeningRange
from .optimizers import OPTIMIZERS


@dataclass(frozen=True)
class Stage:
    """A stretch of training with one crop size and one batch size.

    Attributes:
        crop: side of the square crops, in pixels, a multiple of 8.
        batch: crops in a batch.
        epochs: how often each photograph is seen.
        sides: shorter sides of the views that it takes crops from; default: all that are
            large enough.
    """

    crop: int
    batch: int
    epochs: int
    sides: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.crop < 16 or self.crop % 8:
            raise OptionError(f"crop must be a multiple of 8 from 16 on, not {self.crop}")
        if self.batch < 1 or self.epochs < 1:
            raise OptionError("a stage needs a batch and a number of epochs of at least 1")
        if self.sides and min(self.sides) < self.crop:
            raise OptionError(
                f"a crop of {self.crop} pixels does not fit into views of {min(self.sides)}"
            )

    @classmethod
    def parse(cls, text: str) -> Stage:
        """Read a stage from its text CROPxBATCHxEPOCHS, with @SIDE,SIDE for some views only.

        Example:
            >>> Stage.parse("240x16x40@240")
            Stage(crop=240, batch=16, epochs=40, sides=(240,))
        """
        numbers, at, sides = text.lower().partition("@")
        try:
            crop, batch, epochs = (int(part) for part in numbers.split("x"))
            chosen = tuple(int(part) for part in sides.split(",")) if at else ()
        except ValueError:
            raise OptionError(
                f"a stage is written CROPxBATCHxEPOCHS, as 240x16x40, or 240x16x40@360 for views "
                f"of one size, not {text!r}"
            ) from None
        return cls(crop, batch, epochs, chosen)


@dataclass(frozen=True)
class TrainingOptions:
    """Everything that decides which weights come out, given the photographs.

    Attributes:
        stages: what is trained on, one after the other. Small crops give many cheap
            steps first; whole images last teach what depends on the whole image
            (Harris and Sobel labels are relative to the image's largest response).
        interleave: go through all stages at the same time, their steps evenly mixed, not
            one after the other: every size is seen until the end.
        short_sides: sizes in pixels that the photographs' shorter side is scaled to;
            a crop is taken from those that are large enough. The first is that of validation.
        square: squash the photographs to squares, as the paper does, instead.
        max_photos: use no more photographs than so many, those held out among them; None
            uses all.
        val_fraction: share of the photographs held out for validation, when no folder is named.
        dark_fraction: share of darkened images (paper: a quarter).
        dark_variants: darkened versions of each photograph at each size.
        darkening: ranges of the darkening.
        augmentations: varied views of each photograph at the first size, in normal and in dark
            light: turned, relit, blurred, noisy or compressed (`variation.vary`). Each is taken
            as often as the plain view of a size.
        flips: mirror crops left to right and upside down. The label of a mirrored photograph
            is another one, though: OpenCV's Shi-Tomasi, SIFT, ORB and BRISK mark other pixels.
        transpositions: mirror crops along their diagonal, which changes labels of BRISK only.
        color_jitter: share of crops whose colours are taken away or turned around the luma,
            on which alone labels depend.
        optimizer: "adam", or "soap", which learns more from an image (measured in the model
            card of the bundled weights).
        learning_rate, final_learning_rate: ends of its cosine annealing.
        warm_up: steps over which the rate rises from zero. A run that starts from trained
            weights needs them: Adam's first steps, without moments, would undo a good deal.
        frozen_batch_norm: normalise by the statistics that the start weights bring along, as
            the finished network does, not by those of each batch, which vary much from one
            batch of a few images to the next. None: when a run starts from trained weights.
        pos_weight: weight of a marked pixel in the loss. With 1, where the network is not sure
            it marks too little, since most pixels are not marked: the keypoints above a
            probability of 0.5 are fewer than the labels'. Above 1 there are more of them.
        low_light_pos_weight: the same in crops of low visibility; None: as in all others.
        pos_weight_uncertain: scale these weights by the uncertainty p(1 - p): they hold at a
            probability of one half and fall to 1 where the network is certain, so that certain
            probabilities hardly move.
        freeze_encoder: the encoder, nearly all of the weights, stays as it is, a
            step takes about half of the time, and what the start weights know is kept. For few
            photographs, and for changes of how many pixels are marked.
        detectors: label detectors to fuse.
        label_changes: settings of label detectors that differ from the paper's.
        val_count: how often the validation loss is taken.
        seed: decides the start weights, the order, the crops and what is done to them.

    Raises:
        OptionError: a value is out of its range.
    """

    stages: tuple[Stage, ...] = (Stage(240, 16, 44), Stage(480, 8, 10))
    interleave: bool = False
    short_sides: tuple[int, ...] = (480, 360, 240)
    square: bool = False
    max_photos: int | None = None
    val_fraction: float = 0.05
    dark_fraction: float = 0.25
    dark_variants: int = 1
    darkening: DarkeningRange = field(default_factory=DarkeningRange)
    augmentations: int = 0
    flips: bool = False
    transpositions: bool = True
    color_jitter: float = 0.5
    optimizer: str = "adam"
    learning_rate: float = 1e-3
    final_learning_rate: float = 1e-6
    warm_up: int = 0
    frozen_batch_norm: bool | None = None
    pos_weight: float = 1.0
    low_light_pos_weight: float | None = None
    pos_weight_uncertain: bool = False
    freeze_encoder: bool = False
    detectors: tuple[str, ...] = DETECTOR_NAMES
    label_changes: tuple[SettingChange, ...] = ()
    val_count: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "detectors", LabelOptions(self.detectors).detectors)
        look_up("optimizer", self.optimizer, OPTIMIZERS)
        if not self.stages:
            raise OptionError("a training run needs at least one stage")
        if not self.short_sides or min(self.short_sides) < 16:
            raise OptionError("the short sides must be at least 16 pixels")
        for side in (side for stage in self.stages for side in stage.sides):
            if side not in self.short_sides:
                raise OptionError(
                    f"a stage takes views of {side} pixels, which the short sides lack "
                    f"({', '.join(map(str, self.short_sides))}): add it with --short-side"
                )
        largest = max(stage.crop for stage in self.stages)
        if largest > max(self.short_sides):
            raise OptionError(
                f"a crop of {largest} pixels does not fit into images of "
                f"{max(self.short_sides)}: raise the sizes or make the crops smaller"
            )
        if self.max_photos is not None and self.max_photos < 2:
            raise OptionError(f"max_photos must be at least 2, not {self.max_photos}")
        if not 0 < self.val_fraction < 1:
            raise OptionError(f"the share held out must lie in (0, 1), not {self.val_fraction}")
        if not 0 <= self.dark_fraction <= 1:
            raise OptionError(f"the dark fraction must lie in [0, 1], not {self.dark_fraction}")
        if not 0 <= self.color_jitter <= 1:
            raise OptionError(
                f"the share of colour changes must lie in [0, 1], not {self.color_jitter}"
            )
        if self.augmentations < 0:
            raise OptionError(f"the augmentations must not be negative, not {self.augmentations}")
        if self.dark_variants < 1 or self.val_count < 1:
            raise OptionError("dark variants and val_count must be at least 1")
        for weight in (self.pos_weight, self.low_light_pos_weight):
            if weight is not None and not 0.1 <= weight <= 10:
                raise OptionError(
                    f"the weight of marked pixels must lie in [0.1, 10], not {weight}"
                )
        if self.pos_weight_uncertain and {self.pos_weight, self.low_light_pos_weight or 1} == {1}:
            raise OptionError("pos_weight_uncertain needs a pos_weight other than 1")
        if self.warm_up < 0:
            raise OptionError(f"the warm-up must not be negative, not {self.warm_up} steps")
        if not 0 <= self.seed < 2**31:
            raise OptionError(f"the seed must lie in [0, 2147483647], not {self.seed}")
        if not 0 <= self.final_learning_rate <= self.learning_rate:
            raise OptionError("the learning rate must not be under the final one, nor negative")

    @property
    def label_options(self) -> LabelOptions:
        """How labels are made."""
        return LabelOptions(self.detectors, changes=self.label_changes)

    def to_json(self) -> str:
        """Return the options as JSON text, to be kept beside the weights."""
        return json.dumps(dataclasses.asdict(self), sort_keys=True)
