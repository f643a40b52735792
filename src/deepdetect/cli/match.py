"""`deepdetect match`: matches between two images."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .._shared.errors import OptionError
from .._shared.progress import stage_progress
from .._shared.records import Outputs
from ..detector.detector import DeepDetect
from ..features.matchers import MATCHERS
from ..features.matches import Matches
from ..features.sift import DESCRIPTORS
from ..geometry import GeometryOptions
from ..geometry.estimation import ESTIMATORS, MODEL_NAMES
from ..io.image import load_image
from ..io.tables import save_matches
from ..matching.options import (
    PUBLISHED_MATCHING,
    TWO_VIEW_MODELS,
    UNGUIDED_ONLY,
    MatchingOptions,
)
from ..matching.pipeline import match_images
from ..viz.draw import add_caption, save_picture
from . import _options as cli
from ._detection import NETWORK, POINTS, SELECTION, Detector, chosen_detector

PAIR = cli.From(
    match_images,
    "guided_matching model mutual seed",
    common="guided_matching model mutual",
    flags={"guided_matching": "--guided-matching/--no-guided-matching --unguided"},
    types={"model": Literal[MODEL_NAMES]},
)
MATCHING = cli.From(
    MatchingOptions,
    "two_view_model descriptor keypoint_size angle matcher ratio",
    common="ratio",
    types={
        "two_view_model": Literal[TWO_VIEW_MODELS],
        "descriptor": Literal[tuple(DESCRIPTORS)],
        "matcher": Literal[tuple(name for name in MATCHERS if name != "hamming")],
    },
)
GEOMETRY = cli.From(
    GeometryOptions,
    "estimator inlier_threshold confidence iterations",
    types={"estimator": Literal[ESTIMATORS]},
)


@cli.with_options(PAIR, SELECTION, MATCHING, GEOMETRY, POINTS, NETWORK)
def match(
    image0: cli.Image,
    image1: cli.Image,
    /,
    *,
    output: cli.Folder = Path("deepdetect-output"),
    detector: Detector = "network",
    preset: Literal["default", "published"] = "default",
    homography: Path | None = None,
    camera0: Path | None = None,
    camera1: Path | None = None,
    file_format: cli.Format = "npz",
    pictures: bool = True,
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
    max_megapixels: cli.MaxMegapixels = 200,
    **values: Any,
) -> int:
    """Match the keypoints of two images.

    Writes STEM0_STEM1_matches.npz (or .csv) with the matched positions, their scores, the
    estimated geometry and which matches agree with it, and a picture of them. The options
    --descriptor, --keypoint-size, --angle, --matcher and --ratio apply with --unguided.

    Ends with exit code 3 where there are no matches, as where no geometry between the images can
    be trusted; the file then holds none.

        deepdetect match left.jpg right.jpg
        deepdetect match page1.jpg page2.jpg --model homography --mutual
        deepdetect match left.jpg right.jpg --unguided --ratio 0.9 --mutual
        deepdetect match a.png b.png --preset published --homography H1to2p

    Args:
        preset: Options to start from: default, or published (exactly the paper's code).
        homography: Text file of a known 3x3 homography to evaluate matches by.
        camera0: Text file of the 3x3 camera matrix, for the model essential.
        camera1: The same of the second image.  [default: camera0]
        pictures: Write a picture, too.
    """
    stem = cli.output_folder(output) / f"{image0.stem}_{image1.stem}_matches"
    files = {"file": stem.with_name(f"{stem.name}.{file_format}")}
    files |= {"picture": stem.with_name(f"{stem.name}.jpg")} if pictures else {}
    cli.check_inputs_survive(files.values(), [image0, image1])
    rgb0, rgb1 = load_image(image0), load_image(image1)
    start = MatchingOptions()
    if preset == "published":
        start = PUBLISHED_MATCHING
        values = {"resolution": 480, "guided_matching": False, "model": "none", **values}
    chosen, selection = chosen_detector(detector, values)
    if preset == "published" and isinstance(chosen, DeepDetect):
        chosen = chosen.configured(replace(chosen.heatmap_options, network_channels="bgr"))
    matrices = {"homography": homography, "camera0": camera0, "camera1": camera1 or camera0}
    geometry: dict[str, Any] = {
        name: _read_matrix(path) for name, path in matrices.items() if path is not None
    }
    geometry |= GEOMETRY.take(values)
    changes = MATCHING.take(values)
    options = replace(start, geometry=GeometryOptions(**geometry), **changes)
    stages = GUIDED_STAGES if values.get("guided_matching", True) else UNGUIDED_STAGES
    with cli.writing(Outputs([*files.values()], [image0, image1], overwrite=overwrite)):
        with stage_progress("matching", stages) as done:
            matches = match_images(
                rgb0, rgb1, chosen, selection=selection, options=options, progress=done, **values
            )
        with cli.whole(files) as made:
            save_matches(matches, made["file"])
            if pictures:
                _draw(rgb0, rgb1, matches, made["picture"])
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
        "backend": getattr(chosen, "runtime", None),
        "seconds": {stage: round(value, 4) for stage, value in matches.seconds.items()},
        "file": files["file"],
        "picture": files.get("picture"),
    }
    cli.print_result(as_json, numbers)
    if matches.guided and (unused := [name for name in UNGUIDED_ONLY if name in changes]):
        flags = " and ".join("--" + name.replace("_", "-") for name in unused)
        cli.note(f"only unguided matching uses {flags}: add --unguided")
    if not matches.success:
        cli.note(
            "no geometry between these images can be trusted, so there are no matches: if they "
            "show the same scene, --unguided matches by descriptors alone"
        )
    elif not len(matches):
        cli.note("there are no matches: the images show too little, or the options leave none")
    elif matches.matrix is None and matches.model != "none":
        cli.note(f"no {matches.model} could be estimated from these matches")
    return 0 if len(matches) and matches.success else cli.NOTHING_FOUND


GUIDED_STAGES = ("keypoints", "guided matching", "geometry")
UNGUIDED_STAGES = ("keypoints", "descriptors", "matching", "geometry")


def _two_view_numbers(matches: Matches) -> dict[str, Any] | None:
    found = matches.two_view_geometry
    if found is None:
        return None
    numbers = {name: value for name, value in vars(found).items() if name != "matrix"}
    return {**numbers, "log10_nfa": found.log10_nfa if math.isfinite(found.log10_nfa) else None}


def _draw(rgb0: np.ndarray, rgb1: np.ndarray, matches: Matches, path: Path) -> None:
    picture = matches.draw(rgb0, rgb1, by_position=True)
    others = len(matches) - int(matches.inliers.sum())
    caption = f"{len(matches):,} matches ({matches.model}): matching points share a colour"
    if others:
        caption += f"; {others:,} that do not fit it: red"
    save_picture(add_caption(picture, caption), path)


def _read_matrix(path: Path) -> np.ndarray:
    try:
        return np.loadtxt(path, ndmin=2)
    except FileNotFoundError:
        raise OptionError(f"there is no file {path}: check the path") from None
    except (OSError, ValueError, UnicodeDecodeError):
        raise OptionError(
            f"{path} holds no matrix: it must be three rows of three numbers"
        ) from None
