"""`deepdetect match`: matches between two photographs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    DETECTOR,
    NOTHING_FOUND,
    PATH,
    POINTS,
    SELECTED,
    SELECTION,
    check_inputs_survive,
    chosen_detector,
    detector_option,
    format_option,
    json_option,
    max_megapixels_option,
    output_option,
    overwrite_option,
    pictures_option,
    print_result,
    seconds_rows,
)

if TYPE_CHECKING:
    from ..features.matches import Matches

DETECTED = (*DETECTOR.names, *POINTS.names, "max_keypoints")
MATCHING = FieldOptions(
    "matching.options:MatchingOptions",
    skip=("geometry",),
)
MATCH = FieldOptions(
    "matching.pipeline:match_images",
    names=("guided_matching", "model", "mutual", "seed"),
    flags={"guided_matching": "--guided/--unguided"},
)
GEOMETRY = FieldOptions(
    "geometry.estimation:GeometryOptions",
    names=("estimator", "inlier_threshold", "confidence", "iterations"),
)


@generated_command(
    SELECTION,
    POINTS,
    MATCH,
    MATCHING,
    GEOMETRY,
    DETECTOR,
    short_help="Matches between two photographs.",
)
@click.argument("image0", type=PATH)
@click.argument("image1", type=PATH)
@output_option
@detector_option("network")
@click.option(
    "--preset",
    type=click.Choice(["default", "published"]),
    default="default",
    show_default=True,
    help="Options to start from: default, or published (exactly the paper's code).",
)
@click.option(
    "--homography", type=PATH, help="Text file of a known 3x3 homography to evaluate matches by."
)
@click.option("--camera0", type=PATH, help="Text file of the 3x3 camera matrix, for essential.")
@click.option("--camera1", type=PATH, help="The same of the second image.  [default: camera0]")
@format_option
@pictures_option
@max_megapixels_option
@overwrite_option
@json_option
def match(
    image0: Path,
    image1: Path,
    output: Path,
    kind: str,
    preset: str,
    homography: Path | None,
    camera0: Path | None,
    camera1: Path | None,
    file_format: str,
    pictures: bool,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Match the keypoints of IMAGE0 and IMAGE1.

    Writes STEM0_STEM1_matches.npz (or .csv) with the matched positions, their scores,
    the estimated geometry and which matches agree with it, and a picture of them. The options
    --descriptor, --keypoint-size, --angle, --matcher and --ratio apply with --unguided.

    Ends with exit code 3 where there are no matches, as where no geometry between the images can
    be trusted; the file then holds none.

    \b
    deepdetect match left.jpg right.jpg
    deepdetect match page1.jpg page2.jpg --model homography --mutual
    deepdetect match left.jpg right.jpg --unguided --ratio 0.9 --mutual
    deepdetect match a.png b.png --preset published --homography H1to2p
    """
    from .._shared.progress import stage_progress
    from ..detector.detector import DeepDetect
    from ..geometry import GeometryOptions
    from ..io.image import load_image
    from ..io.tables import save_matches
    from ..matching.options import PUBLISHED_MATCHING, UNGUIDED_ONLY, MatchingOptions
    from ..matching.pipeline import match_images
    from ._records import claimed_outputs

    stem = f"{image0.stem}_{image1.stem}_matches"
    file = output / f"{stem}.{file_format}"
    picture = output / f"{stem}.jpg" if pictures else None
    files = [path for path in (file, picture) if path is not None]
    check_inputs_survive(files, [image0, image1], "choose another folder with -o")
    rgb0, rgb1 = load_image(image0), load_image(image1)
    start, given = MatchingOptions(), given_only(values)
    if preset == "published":
        start = PUBLISHED_MATCHING
        given = {"resolution": 480, "guided_matching": False, "model": "none", **given}
    for_detector = {name: given.pop(name, None) for name in (*DETECTED, *SELECTED)}
    detector, selection = chosen_detector(kind, for_detector)
    if preset == "published" and isinstance(detector, DeepDetect):
        detector = detector.configured(replace(detector.heatmap_options, network_channels="bgr"))
    matrices = {"homography": homography, "camera0": camera0, "camera1": camera1 or camera0}
    geometry = {name: _read_matrix(path) for name, path in matrices.items() if path is not None}
    geometry |= {name: given.pop(name) for name in GEOMETRY.names if name in given}
    changes = {name: given.pop(name) for name in vars(start) if name in given}
    options = replace(start, geometry=GeometryOptions(**geometry), **changes)
    stages = GUIDED_STAGES if given.get("guided_matching", True) else UNGUIDED_STAGES
    with claimed_outputs("match", [image0, image1], files, overwrite):
        with stage_progress("matching", stages) as done:
            matches = match_images(
                rgb0, rgb1, detector, selection=selection, options=options, progress=done, **given
            )
        save_matches(matches, file)
        if picture is not None:
            _draw(rgb0, rgb1, matches, picture)
    guide = matches.two_view_geometry
    numbers = {
        "image0": image0,
        "image1": image1,
        "keypoints0": len(matches.keypoints0),
        "keypoints1": len(matches.keypoints1),
        "density0": round(matches.keypoints0.density, 6),
        "density1": round(matches.keypoints1.density, 6),
        "matches": len(matches),
        "inliers": int(matches.inliers.sum()),
        "model": matches.model,
        "matrix": None if matches.matrix is None else matches.matrix.tolist(),
        "guided": matches.guided,
        "success": matches.success,
        "two_view_geometry": _two_view_numbers(matches),
        "backend": getattr(detector, "runtime", None),
        "seconds": {stage: round(value, 4) for stage, value in matches.seconds.items()},
        "file": file,
        "picture": picture,
    }
    if matches.guided and (unused := [name for name in UNGUIDED_ONLY if name in changes]):
        words = " and ".join("--" + name.replace("_", "-") for name in unused)
        verb = "applies" if len(unused) == 1 else "apply"
        click.echo(f"{words} {verb} only to unguided matching: add --unguided", err=True)
    print_result(
        as_json,
        numbers,
        [
            ("keypoints", f"{numbers['keypoints0']:,} and {numbers['keypoints1']:,}"),
            ("density", f"{numbers['density0']:.3f} and {numbers['density1']:.3f}"),
            ("matches", f"{len(matches):,}"),
            (_inliers_label(matches.model, homography is not None), f"{numbers['inliers']:,}"),
            ("guided by", guide.model if guide and matches.guided else "nothing"),
            *seconds_rows(matches.seconds),
            ("written", ", ".join(str(path) for path in files)),
        ],
        f"{image0} and {image1}",
    )
    if not matches.success:
        click.echo(
            "no geometry between these images can be trusted, so there are no matches: if they "
            "show the same scene, --unguided matches by descriptors alone",
            err=True,
        )
        raise click.exceptions.Exit(NOTHING_FOUND)
    if not len(matches):
        click.echo(
            "there are no matches: the images show too little, or the options leave none", err=True
        )
        raise click.exceptions.Exit(NOTHING_FOUND)
    if as_json:
        return
    if matches.matrix is None and matches.model != "none":
        click.echo(f"no {matches.model} could be estimated from these matches", err=True)


GUIDED_STAGES = ("keypoints", "guided matching", "geometry")
UNGUIDED_STAGES = ("keypoints", "descriptors", "matching", "geometry")


def _inliers_label(model: str, given: bool) -> str:
    return "within the threshold of --homography" if given else f"inliers ({model})"


def _two_view_numbers(matches: Matches) -> dict[str, Any] | None:
    found = matches.two_view_geometry
    if found is None:
        return None
    numbers = {name: value for name, value in vars(found).items() if name != "matrix"}
    return {**numbers, "log10_nfa": found.log10_nfa if math.isfinite(found.log10_nfa) else None}


def _draw(rgb0: Any, rgb1: Any, matches: Any, path: Path) -> None:
    from ..viz.draw import add_caption, save_picture

    picture = matches.draw(rgb0, rgb1, by_position=True)
    others = len(matches) - int(matches.inliers.sum())
    caption = (
        f"{len(matches):,} matches ({matches.model}), of equal colour where they belong together"
    )
    if others:
        caption += f"; {others:,} that do not fit it: red"
    save_picture(add_caption(picture, caption), path)


def _read_matrix(path: Path) -> Any:
    import numpy as np

    from .._shared.errors import OptionError

    try:
        return np.loadtxt(path, ndmin=2)
    except FileNotFoundError:
        raise OptionError(f"there is no file {path}: check the path") from None
    except (OSError, ValueError, UnicodeDecodeError):
        raise OptionError(
            f"{path} holds no matrix: it must be three rows of three numbers"
        ) from None
