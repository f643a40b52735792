"""Training recipes, their presets, and device options."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from deepdetect._shared.errors import OptionError, check_name
from deepdetect._shared.machine import processor_count
from deepdetect._shared.options import check_ranges, suggest_keywords

from ..labels import LABEL_SETTINGS, LabelOptions

InitWeights = str | Path | Sequence[str | Path]


@dataclass(frozen=True)
class Stage:
    """A part of the training with one crop size and one batch size.

    Attributes:
        crop: side of the square crops in pixels, a multiple of 8.
        batch: number of crops per batch.
        epochs: number of times that each image is used.
        sides: crop only views with these shorter sides. Empty: all views that are large enough.
    """

    crop: int
    batch: int
    epochs: int
    sides: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.crop < 16 or self.crop % 8:
            raise OptionError(f"`crop` must be a multiple of 8, at least 16, not {self.crop}")
        if self.batch < 1 or self.epochs < 1:
            raise OptionError("`batch` and `epochs` of a stage must be at least 1")
        if self.sides and min(self.sides) < self.crop:
            raise OptionError(
                f"a crop of {self.crop} pixels does not fit into views with a shorter side of "
                f"{min(self.sides)}"
            )

    @classmethod
    def parse(cls, text: str) -> Stage:
        """Read a stage from a text of the form CROPxBATCHxEPOCHS or CROPxBATCHxEPOCHS@SIDE,SIDE.

        With SIDE, crops are taken only from views with these shorter sides.

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
                f"a stage has the form CROPxBATCHxEPOCHS, such as '240x16x40', or '240x16x40@360' "
                f"to crop only views with a shorter side of 360 pixels, not {text!r}"
            ) from None
        return cls(crop, batch, epochs, chosen)


@suggest_keywords
@dataclass(frozen=True)
class TrainingOptions:
    """Options for training the detector network that change the resulting weights.

    Attributes:
        network: name of the network: "fast" or "espnet".
        stages: stages of the training in order. Crops should be whole views, because Harris and
            Sobel labels and the network `fast` depend on the whole image. Smaller crops are
            cheaper.
        interleave: mix the steps of all stages evenly, so that all crop sizes are used to the end.
        short_sides: sizes in pixels to which the shorter side of each image is scaled, one view for
            each size. Validation uses the first size.
        square: make images square: "crop" takes the central square, "squash" resizes without
            keeping the aspect ratio, as in the paper. None: keep the aspect ratio.
        max_images: use at most this many images, including those for validation.
        val_fraction: fraction of the images held out for validation, if no folder is given for it.
        dark_fraction: fraction of darkened crops (paper: a quarter).
        augmentations: number of augmented views (rotated, relit, blurred, noisy or compressed) of
            each image, in normal and again in dark light. Their size is the first of `short_sides`.
        transpositions: mirror half of the crops along their diagonal. Only BRISK would label a
            mirrored crop differently. Flips would also change labels of Shi-Tomasi, SIFT and ORB.
        color_jitter: fraction of the crops whose colours are removed or rotated. The luma, on which
            labels and `fast` depend, changes by at most one grey level.
        sensor_noise: fraction of the dark crops that get the noise of a sensor, while their labels
            are those of the view without it.
        optimizer: "adam", or "soap", which learns more per image (measurements: lab/HISTORY.md).
        learning_rate: learning rate at the start of cosine annealing, which ends at 1e-6.
        warm_up: fraction of the steps over which the learning rate rises from zero. It protects
            trained initial weights, which the inaccurate first steps of Adam would spoil.
        average_decay: decay per step of the exponential average of the weights; the average is
            validated and saved, and with 0 it equals the weights.
        max_gradient_norm: gradients with a larger norm are scaled down to it; None: no limit.
        frozen_batch_norm: normalise by the statistics stored with the initial weights, because
            those of small batches are unreliable. None: only if the initial weights are trained.
        pos_weight: weight in the loss of pixels that are marked in the label. With 1, an uncertain
            network marks too few pixels, because most are not marked. Above 1, it marks more.
        low_light_pos_weight: `pos_weight` in crops of low visibility. None: equal to `pos_weight`.
        labels: the label detectors and their settings.
        val_count: number of validations.
        seed: seed of the initial weights, the image order, the crops and their augmentation.

    Raises:
        OptionError: a value is out of its range.
    """

    network: str = "fast"
    stages: tuple[Stage, ...] = (
        Stage(480, 16, 40, (480,)),
        Stage(240, 64, 36, (240,)),
        Stage(352, 30, 16, (352,)),
        Stage(960, 4, 2, (960,)),
    )
    interleave: bool = True
    short_sides: tuple[int, ...] = (480, 240, 352, 960)
    square: Literal["crop", "squash"] | None = "crop"
    max_images: int | None = None
    val_fraction: float = 0.05
    dark_fraction: float = 0.5
    augmentations: int = 4
    transpositions: bool = True
    color_jitter: float = 0.0
    sensor_noise: float = 0.0
    optimizer: str = "soap"
    learning_rate: float = 2e-3
    warm_up: float = 0.05
    average_decay: float = 0.999
    max_gradient_norm: float | None = 1.0
    frozen_batch_norm: bool | None = None
    pos_weight: float = 1.0
    low_light_pos_weight: float | None = None
    labels: LabelOptions = field(default_factory=LabelOptions)
    val_count: int = 12
    seed: int = 0

    def __post_init__(self) -> None:
        check_name("optimizer", self.optimizer, ("adam", "soap"))
        if self.square is not None:
            check_name("square", self.square, ("crop", "squash"))
        self._check_sizes()
        check_ranges(
            self,
            positive=("learning_rate", "max_gradient_norm"),
            not_negative=("augmentations",),
            fractions=("dark_fraction", "color_jitter", "sensor_noise", "warm_up", "average_decay"),
            counts=("val_count",),
            between={
                "max_images": (2, math.inf),
                "pos_weight": (0.1, 10),
                "low_light_pos_weight": (0.1, 10),
                "seed": (0, 2**31 - 1),
            },
        )
        if not 0 < self.val_fraction < 1:
            raise OptionError(f"`val_fraction` must lie in (0, 1), not {self.val_fraction}")

    def _check_sizes(self) -> None:
        if not self.stages or not self.short_sides or min(self.short_sides) < 16:
            raise OptionError(
                "give one or more `stages` and `short_sides`, and no side below 16 pixels"
            )
        for side in (side for stage in self.stages for side in stage.sides):
            if side not in self.short_sides:
                raise OptionError(
                    f"a stage crops views with a shorter side of {side} pixels, which is not among "
                    f"`short_sides` ({', '.join(map(str, self.short_sides))}): add it"
                )
        largest = max(stage.crop for stage in self.stages)
        if largest > max(self.short_sides):
            raise OptionError(
                f"a crop of {largest} pixels does not fit into views with a shorter side of "
                f"{max(self.short_sides)}: make `short_sides` larger or the crops smaller"
            )


@suggest_keywords
@dataclass(frozen=True)
class DeviceOptions:
    """Options for running the training on a machine; they are not a part of the recipe.

    Attributes:
        device: "auto" (CUDA if there is a GPU, else the CPU), "cpu" or "cuda".
        precision: "float32", "bfloat16" or "auto": bfloat16 if the hardware computes with it.
        compile: use torch.compile; by default on a GPU, or if there is a C++ compiler.
        threads: number of CPU threads of torch; by default torch's choice.
        num_workers: number of processes that load and augment crops; with 0, the training process
            does it. None: 0 on a CPU; on a GPU, one less than the number of processors.
    """

    device: Literal["auto", "cpu", "cuda"] = "auto"
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    compile: bool | None = None
    threads: int | None = None
    num_workers: int | None = None

    def __post_init__(self) -> None:
        check_name("device", self.device, ("auto", "cpu", "cuda"))
        check_name("precision", self.precision, ("auto", "float32", "bfloat16"))
        check_ranges(self, counts=("threads",), not_negative=("num_workers",))

    @property
    def accelerator(self) -> str:
        """The device on which to train: "cpu" or "cuda", chosen here if `device` is "auto"."""
        if self.device != "auto":
            return self.device
        from torch.cuda import is_available

        return "cuda" if is_available() else "cpu"

    @property
    def worker_count(self) -> int:
        """The number of loading processes: `num_workers`, or its default if that is None."""
        if self.num_workers is not None:
            return self.num_workers
        return 0 if self.accelerator == "cpu" else max(1, processor_count() - 1)


@suggest_keywords
@dataclass(frozen=True)
class PointsTrainingOptions:
    """Options for training the keypoint ranker.

    Attributes:
        steps: optimiser steps.
        pairs: pairs of views in each step.
        side: side of the square views, in pixels.
        learning_rate: highest learning rate; cosine annealing ends at 2 % of it.
        min_density, max_density: smallest and largest number of keypoints per pixel that the ranker
            learns to choose. The number for a pair is drawn log-uniformly between them.
        val_count: number of validations, besides one before the first step.
        val_pairs: number of validation pairs of each kind: zoom, blur, viewpoint, light.
        seed: seed of the weights and the pairs.

    Raises:
        OptionError: a value is out of its range.
    """

    steps: int = 3000
    pairs: int = 4
    side: int = 224
    learning_rate: float = 3e-3
    min_density: float = 0.003
    max_density: float = 0.025
    val_count: int = 12
    val_pairs: int = 24
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("learning_rate", "min_density", "max_density"),
            not_negative=("seed",),
            counts=("steps", "pairs", "val_count", "val_pairs"),
            between={"side": (64, math.inf)},
        )
        if self.min_density > self.max_density:
            raise OptionError("`min_density` must not be above `max_density`")


@suggest_keywords
@dataclass(frozen=True)
class DescriptorTrainingOptions:
    """Options for training the learned descriptor.

    Attributes:
        steps: optimiser steps.
        pairs: pairs of views in each step.
        learning_rate: highest learning rate (of Muon), after the warm-up; it falls linearly to 0.
        val_count: number of validations.
        val_pairs: number of validation pairs of each kind: upright, rotated, zoomed.
        crops: number of crops in each step, from photographs with `readings`; 0: no teachers.
        seed: seed of the weights and the pairs.

    Raises:
        OptionError: a value is out of its range.
    """

    steps: int = 4000
    pairs: int = 8
    learning_rate: float = 0.012
    val_count: int = 12
    val_pairs: int = 48
    crops: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("learning_rate",),
            not_negative=("seed", "crops"),
            counts=("steps", "val_count", "val_pairs"),
            between={"pairs": (1, 400)},
        )


@suggest_keywords
@dataclass(frozen=True)
class MatchFilterTrainingOptions:
    """Options for training the match filter.

    Attributes:
        steps: optimiser steps.
        pairs: pairs of views in each step, each varied at random.
        drawn: number of pairs drawn before the first step. All steps take their pairs from them.
        learning_rate: highest learning rate, after the warm-up; it falls linearly to 0.
        val_count: number of validations.
        val_pairs: number of validation pairs.
        seed: seed of the weights and the pairs.

    Raises:
        OptionError: a value is out of its range.
    """

    steps: int = 2400
    pairs: int = 8
    drawn: int = 3600
    learning_rate: float = 4e-3
    val_count: int = 12
    val_pairs: int = 480
    seed: int = 0

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("learning_rate",),
            not_negative=("seed",),
            counts=("steps", "pairs", "drawn", "val_count"),
            between={"val_pairs": (4, math.inf)},
        )


@suggest_keywords
@dataclass(frozen=True)
class MatcherTrainingOptions(MatchFilterTrainingOptions):
    """Options for training the matcher: as for the match filter, with other defaults.

    Attributes:
        steps: optimiser steps.
        pairs: pairs of images in each step, each varied at random.
        drawn: number of pairs drawn before the first step. All steps take their pairs from them.
        learning_rate: highest learning rate, after the warm-up; it falls linearly to 0.
        val_count: number of validations.
        val_pairs: number of validation pairs.
        seed: seed of the weights and the pairs.
    """

    steps: int = 2000
    pairs: int = 4
    drawn: int = 3000
    learning_rate: float = 3e-4
    val_pairs: int = 60


_ESPNET = TrainingOptions(
    network="espnet",
    stages=(Stage(240, 16, 44), Stage(480, 8, 10)),
    interleave=False,
    short_sides=(480, 360, 240),
    square=None,
    dark_fraction=0.25,
    augmentations=0,
    color_jitter=0.5,
    optimizer="adam",
    learning_rate=1e-3,
    warm_up=0.0,
    average_decay=0.0,
    max_gradient_norm=None,
)

PRESETS: dict[str, TrainingOptions] = {
    # Crops are whole views of several sizes, in normal and dark light. Weights are averaged.
    "default": TrainingOptions(),
    # Small crops come first. The views have several sizes, and keep the images' aspect ratio.
    "espnet": _ESPNET,
    # As in the paper (Section III-B), about 33,000 images are for training, 8,000 for validation,
    # all squashed to 480x480. A quarter of the crops are darkened. Batches have 64 crops.
    "paper": replace(
        _ESPNET,
        stages=(Stage(480, 64, 100),),
        short_sides=(480,),
        square="squash",
        max_images=41_000,
        val_fraction=8 / 41,
        transpositions=False,
        color_jitter=0.0,
        val_count=20,
    ),
    # This recipe is for two-view geometry, like the paper's second weights (Figure 8): labels mark
    # more pixels, and all views are in normal light. It is meant to start from trained weights.
    "dense": TrainingOptions(
        dark_fraction=0.0, labels=LABEL_SETTINGS["dense"], learning_rate=1.5e-3
    ),
}
