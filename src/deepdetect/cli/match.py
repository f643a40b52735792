"""`deepdetect match`: matches between two photographs."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    DETECTOR,
    NOTHING_FOUND,
    PATH,
    SELECTION,
    check_inputs_survive,
    format_option,
    json_option,
    make_detector,
    max_megapixels_option,
    output_option,
    overwrite_option,
    pictures_option,
    print_result,
    seconds_rows,
)

MATCHING = FieldOptions(
    "matching.options:MatchingOptions",
    skip=("heatmap", "selection", "guided_options", "geometry"),
    flags={"guided": "--guided/--unguided"},
)
GEOMETRY = FieldOptions(
    "geometry.estimation:GeometryOptions",
    names=("model", "estimator", "inlier_threshold", "confidence", "iterations", "seed"),
    defaults={"model": "auto"},
)


@generated_command(
    SELECTION, MATCHING, GEOMETRY, DETECTOR, short_help="Matches between two photographs."
)
@click.argument("image0", type=PATH)
@click.argument("image1", type=PATH)
@output_option
@click.option(
    "--preset",
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
    from ..io.image import load_image
    from ..io.tables import save_matches
    from ..matching.options import UNGUIDED_ONLY, get_preset
    from ..matching.pipeline import match_images
    from ._records import claimed_outputs

    stem = f"{image0.stem}_{image1.stem}_matches"
    file = output / f"{stem}.{file_format}"
    picture = output / f"{stem}.jpg" if pictures else None
    files = [path for path in (file, picture) if path is not None]
    check_inputs_survive(files, [image0, image1], "choose another folder with -o")
    rgb0, rgb1 = load_image(image0), load_image(image1)
    resolution_given = values["resolution"] is not None
    detector = make_detector(values)
    given = given_only(values)
    for name, path in (
        ("homography", homography),
        ("camera0", camera0),
        ("camera1", camera1 or camera0),
    ):
        if path is not None:
            given[name] = _read_matrix(path)
    if get_preset(preset).heatmap is not None and resolution_given:
        given["resolution"] = detector.heatmap_options.resolution
    guided = given.get("guided", get_preset(preset).guided)
    with claimed_outputs("match", [image0, image1], files, overwrite):
        with stage_progress("matching", GUIDED_STAGES if guided else UNGUIDED_STAGES) as done:
            matches = match_images(rgb0, rgb1, detector, preset=preset, progress=done, **given)
        save_matches(matches, file)
        if picture is not None:
            _draw(rgb0, rgb1, matches, picture)
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
        "lost": matches.lost,
        "guide": _guide_numbers(matches),
        "backend": detector.runtime,
        "seconds": {stage: round(value, 4) for stage, value in matches.seconds.items()},
        "file": file,
        "picture": picture,
    }
    if matches.guided and (unused := [name for name in UNGUIDED_ONLY if name in given]):
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
            ("guided by", matches.guide.model if matches.guide and matches.guided else "nothing"),
            *seconds_rows(matches.seconds),
            ("written", ", ".join(str(path) for path in files)),
        ],
        f"{image0} and {image1}",
    )
    if matches.lost:
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


def _guide_numbers(matches: Any) -> dict[str, Any] | None:
    guide = matches.guide
    if guide is None:
        return None
    return {
        "model": guide.model,
        "sparse_matches": guide.sparse_matches,
        "sparse_inliers": guide.sparse_inliers,
        "log10_nfa": guide.log10_nfa if math.isfinite(guide.log10_nfa) else None,
        "simulated_views": guide.simulated_views,
    }


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
