"""Options, and ways to print results, that several commands share."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .._shared.errors import BatchError, DeepDetectError, OptionError
from ._generated import FieldOptions, given_only

if TYPE_CHECKING:
    from ..detector.detector import DeepDetect
    from ..detector.point_detector import PointDetector
    from ..features.selection import SelectionOptions
    from ..labels import LabelOptions
    from ..training import TrainingOptions

PATH = click.Path(path_type=Path)

NOTHING_FOUND = 3
"""Exit code where all went well and nothing was found."""


class Resolution(click.ParamType):  # type: ignore[type-arg]  # generic in new versions only
    """The word "auto" or "native", or a number of pixels."""

    name = "auto|native|PIXELS"

    def convert(self, value: Any, param: Any, context: Any) -> str | int:
        if value in ("auto", "native") or isinstance(value, int):
            return value
        try:
            return int(value)
        except ValueError:
            message = f"{value!r} is neither 'auto' nor 'native' nor a number of pixels"
            self.fail(message, param, context)


class TileSize(click.ParamType):  # type: ignore[type-arg]  # as above
    """The word "auto", or a number of megapixels."""

    name = "auto|MEGAPIXELS"

    def convert(self, value: Any, param: Any, context: Any) -> str | float:
        if value == "auto" or isinstance(value, float):
            return value
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r} is neither 'auto' nor a number of megapixels", param, context)


DETECTOR = FieldOptions(
    "detector.detector:DeepDetect",
    names=(
        "weights",
        "resolution",
        "backend",
        "device",
        "threads",
        "precision",
        "tta",
        "tile_megapixels",
    ),
    types={"resolution": Resolution(), "tile_megapixels": TileSize()},
    metavars={"weights": "NAME|FILE", "device": "cpu|cuda|PROVIDER"},
    defaults={"threads": "the backend's choice"},
)
POINTS = FieldOptions(
    "detector.point_detector:PointDetector",
    names=("spread", "ranker"),
    metavars={"ranker": "FILE"},
)

SELECTION = FieldOptions(
    "features.selection:SelectionOptions",
    defaults={"max_keypoints": "2048 with --detector points, else all"},
)


def detector_option(default: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the option that chooses between the two detectors.

    Args:
        default: one of them; or what the help says of a command that chooses itself.
    """
    kinds = ["network", "points"]
    return click.option(
        "--detector",
        "kind",
        type=click.Choice(kinds),
        default=default if default in kinds else None,
        help="Pixels of the network's heat map, or ranked points of all scales.  "
        f"[default: {default}]",
    )


output_option = click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("deepdetect-output"),
    show_default=True,
    help="Folder for the results.",
)


def _limit_megapixels(context: click.Context, _: click.Parameter, value: float | None) -> None:
    if value is not None:
        from ..io.image_file import limit_megapixels

        context.with_resource(limit_megapixels(value))


max_megapixels_option = click.option(
    "--max-megapixels",
    type=float,
    callback=_limit_megapixels,
    expose_value=False,
    help="Refuse larger photographs before they are decoded.  [default: 200]",
)
format_option = click.option(
    "--format",
    "file_format",
    type=click.Choice(["npz", "csv"]),
    default="npz",
    show_default=True,
    help="Format of the data files.",
)
pictures_option = click.option(
    "--pictures/--no-pictures", default=True, show_default=True, help="Write pictures, too."
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace what exists already, and do all of it again."
)
workers_option = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Processes that make labels.  [default: one a processor]",
)
processes_option = click.option(
    "--workers",
    type=click.IntRange(min=1),
    help="Processes at work.  [default: one per processor of the machine or cluster]",
)
engine_option = click.option(
    "--engine",
    metavar="NAME",
    default="processes",
    show_default=True,
    help="What does the work: processes of this machine, or ray for a cluster (RAY_ADDRESS).",
)
label_settings_option = click.option(
    "--label-settings",
    metavar="NAME|FILE.toml",
    help="Detectors and their settings: paper or dense, or a file.  [default: paper]",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")


def chosen_label_settings(detectors: str | None, chosen: str | None) -> LabelOptions:
    """Find settings by name or TOML file; detectors (with commas between) replace theirs."""
    from ..labels import find_label_settings

    settings = find_label_settings("paper" if chosen is None else chosen)
    if detectors is None:
        return settings
    names = tuple(name.strip() for name in detectors.split(",") if name.strip())
    return dataclasses.replace(settings, detectors=names)


RECIPE = FieldOptions(
    "training.recipe:TrainingOptions",
    skip=("labels",),
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
    names=("short_sides", "square", "max_images", "val_fraction", "augmentations"),
    flags=RECIPE.flags,
    defaults=RECIPE.defaults,
)
"""What of a recipe is fixed once the labels are made."""


def recipe_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options that choose a recipe, before others change it."""
    function = label_settings_option(function)
    function = click.option(
        "--detectors", metavar="NAME,NAME,...", help="Label detectors.  [default: all nine]"
    )(function)
    return click.option(
        "--preset",
        default="default",
        show_default=True,
        help="Recipe that the other options change: default (its values are shown here), paper "
        "(the paper's own), or dense (normal light only, denser labels).",
    )(function)


def chosen_recipe(
    preset: str, detectors: str | None, label_settings: str | None, values: dict[str, Any]
) -> TrainingOptions:
    """Return a preset's training options with the given values changed."""
    from ..training import Stage, training_preset

    given = given_only(values)
    if "stages" in given:
        given["stages"] = tuple(
            Stage.parse(stage) if isinstance(stage, str) else stage for stage in given["stages"]
        )
    recipe = training_preset(preset)
    if label_settings is not None:
        given["labels"] = chosen_label_settings(detectors, label_settings)
    elif detectors is not None:  # the preset's settings, for the detectors that are used
        chosen = chosen_label_settings(detectors, None).detectors
        given["labels"] = recipe.labels.with_detectors(chosen)
    return dataclasses.replace(recipe, **given)


def make_detector(values: dict[str, Any], weights: str = "default") -> DeepDetect:
    """Make the network that `DETECTOR`'s options describe, taking them out of the values."""
    from ..detector.detector import DeepDetect

    given = given_only({name: values.pop(name) for name in DETECTOR.names})
    return DeepDetect(**{"weights": weights, **given})


SELECTED = ("threshold", "density", "nms_radius", "subpixel")
"""Options of the network's keypoints alone."""


def chosen_detector(
    kind: str,
    values: dict[str, Any],
    *,
    weights: str = "default",
    max_keypoints: int = 2048,
    threads: int | None = None,
) -> tuple[DeepDetect | PointDetector, SelectionOptions | None]:
    """Make the detector that is chosen, and its selection, taking their options out of the values.

    Args:
        kind: "network" or "points".
        values: of `DETECTOR`, `POINTS` and `SELECTION`.
        weights, threads: of the network, where nothing else is given.
        max_keypoints: of points, where nothing else is given.
    """
    from ..detector.detector import DeepDetect
    from ..detector.point_detector import PointDetector
    from ..features.selection import SelectionOptions

    names = (*DETECTOR.names, *POINTS.names, *SELECTED, "max_keypoints")
    given = given_only({name: values.pop(name) for name in names if name in values})
    network = [name for name in DETECTOR.names if name != "resolution"]
    others = (*network, *SELECTED) if kind == "points" else POINTS.names
    for name in given:
        if name in others:
            other = "network" if kind == "points" else "points"
            flag = "--" + name.replace("_", "-")
            raise OptionError(f"{flag} is for --detector {other}: leave it out, or choose that")
    if kind == "points":
        return PointDetector(**{"max_keypoints": max_keypoints, **given}), None
    own = {name: given.pop(name) for name in DETECTOR.names if name in given}
    detector = DeepDetect(**{"weights": weights, "threads": threads, **own})
    return detector, SelectionOptions(**given)


def expand_images(paths: Sequence[Path], output: Path) -> list[Path]:
    """Replace folders by the images below them, and check that results will not collide.

    The folder of the results is left out when it lies in one of the folders; where it is one of
    them, what earlier runs made in it.

    Raises:
        ImageError: a folder holds no image.
        OptionError: two images have one name, or a folder holds only what earlier runs made.
    """
    images: list[Path] = []
    for path in paths:
        images += _images_below(path, output) if path.is_dir() else [path]
    seen: dict[str, Path] = {}
    for image in dict.fromkeys(images):
        if image.stem in seen:
            raise OptionError(
                f"{seen[image.stem]} and {image} would write the same files: "
                "rename one, or do them one after the other into two folders"
            )
        seen[image.stem] = image
    return list(seen.values())


def _images_below(folder: Path, output: Path) -> list[Path]:
    """List the images below a folder that no earlier run has made."""
    from ..io.image import find_images
    from ._records import recorded_outputs

    images = find_images(folder, [output])
    if folder.resolve() != output.resolve():
        return images
    made = recorded_outputs(output)
    left = [image for image in images if image.resolve() not in made]
    if not left:
        raise OptionError(
            f"all images in {folder} are results of earlier runs: choose another folder with -o"
        )
    return left


def check_inputs_survive(outputs: Iterable[Path], inputs: Sequence[Path], advice: str) -> None:
    """Check that no file to be written is one of those that are read, under whatever name.

    The advice says what to do, as "give the model another name by -o".
    """
    # Not by name: links, and capitals on some systems, give one file several.
    there = {_identity(path) for path in inputs} - {None}
    for output in outputs:
        if _identity(output) in there:
            raise OptionError(f"{output} would be written over, which is an input: {advice}")


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from all others, or None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def report_failures(failures: Sequence[str], total: int, what: str = "images") -> None:
    """Raise a BatchError when some of several images failed; of a single one, its error."""
    if failures and total == 1:
        raise DeepDetectError(failures[0])
    if failures:
        raise BatchError(f"{len(failures)} of {total} {what} failed, the others are done", failures)


def print_json(value: Any) -> None:
    """Print a value as JSON; paths become text."""
    click.echo(json.dumps(value, indent=2, default=str))


def print_result(
    as_json: bool, values: Any, rows: Iterable[tuple[str, str]], title: str = ""
) -> None:
    """Print the result of a command: as JSON, or as a table of names and values."""
    if as_json:
        print_json(values)
    else:
        print_table(rows, title)


def print_table(rows: Iterable[tuple[str, str]], title: str = "") -> None:
    """Print names and values in two columns."""
    if title:
        click.echo(title)
    rows = list(rows)
    width = max((len(name) for name, _ in rows), default=0)
    for name, value in rows:
        click.echo(f"  {name:<{width}}  {value}")


def seconds_rows(seconds: dict[str, float]) -> list[tuple[str, str]]:
    """Make the table rows for the time of each stage."""
    return [(f"seconds: {stage}", f"{value:.3f}") for stage, value in seconds.items()]
