"""`deepdetect detect`: keypoints of photographs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .. import __version__
from ._generated import generated_command, with_flags
from ._options import (
    DETECTOR,
    NOTHING_FOUND,
    PATH,
    POINTS,
    SELECTION,
    check_inputs_survive,
    chosen_detector,
    detector_option,
    expand_images,
    format_option,
    json_option,
    max_megapixels_option,
    output_option,
    overwrite_option,
    pictures_option,
    print_json,
    report_failures,
)

if TYPE_CHECKING:
    import numpy as np

    from ..detector.detector import DeepDetect
    from ..detector.point_detector import PointDetector
    from ..features.selection import SelectionOptions
    from ._records import OutputRecords

NUMBERS = ("width", "height", "keypoints", "density", "seconds")
"""What is told of each image, and recorded."""

POINT_PICTURES, PICTURES = ("keypoints",), ("keypoints", "dense", "heatmap")


@generated_command(SELECTION, POINTS, DETECTOR, short_help="Keypoints of photographs.")
@click.argument("images", type=PATH, nargs=-1, required=True)
@output_option
@detector_option("network")
@click.option(
    "--ignore",
    type=PATH,
    help="Mask image of the same size: no keypoints where it is bright.",
)
@format_option
@pictures_option
@overwrite_option
@max_megapixels_option
@json_option
def detect(
    images: tuple[Path, ...],
    output: Path,
    kind: str,
    ignore: Path | None,
    file_format: str,
    pictures: bool,
    overwrite: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Detect the keypoints of IMAGES (files or folders).

    Writes for each image STEM.npz (or .csv) with the positions and scores, and the pictures
    STEM_keypoints.jpg (the best of all parts of the image, coloured by score), and of the network
    STEM_dense.jpg (all keypoints) and STEM_heatmap.jpg (logits).

    Images that are done are skipped when the same command runs again, and done again with other
    options. What was made from other images of the same name, or by something else, is replaced
    with --overwrite only. An image
    that cannot be read does not stop the others: they are listed at the end, with exit code 1.
    Where no image has any keypoint the exit code is 3.

    \b
    deepdetect detect photo.jpg
    deepdetect detect photos/ -o keypoints --detector points --spread grid
    deepdetect detect photo.jpg --density 0.1 --format csv
    """
    from .._shared.opencv import import_opencv
    from .._shared.progress import progress
    from ..io.masks import load_mask
    from ._records import OutputRecords, file_digest

    import_opencv()  # what is missing is said before anything is written
    paths = expand_images(images, output)
    shown = (POINT_PICTURES if kind == "points" else PICTURES) if pictures else ()
    outputs = {path: _outputs(path, output, file_format, shown) for path in paths}
    written = [file for files in outputs.values() for file in files.values()]
    check_inputs_survive(written, paths, "choose another folder with -o")
    mask = load_mask(ignore) if ignore is not None else None
    detector, selection = chosen_detector(kind, values)
    settings = {
        **detector.settings,
        **({} if selection is None else vars(selection)),
        "ignore": None if ignore is None else file_digest(ignore),
        "version": __version__,
    }
    backend = getattr(detector, "runtime", None)
    records = OutputRecords("detect", output, settings, overwrite)
    for path, files in outputs.items():  # before any work
        records.find(path, list(files.values()))
    if records.changed:
        names = sorted({name for changed in records.changed.values() for name in changed})
        others = with_flags(
            ", ".join(f"`{name}`" for name in names), click.get_current_context().command
        )
        count = len(records.changed)
        whose = str(next(iter(records.changed))) if count == 1 else f"{count} images"
        click.echo(f"replacing the results of {whose} with other options ({others})", err=True)
    results: list[dict[str, Any]] = []
    failures = []
    with progress(len(paths), "detecting", "image", quiet=len(paths) == 1) as bar:
        for path, files in outputs.items():
            try:
                results.append(_detect_one(path, detector, selection, mask, files, records))
            except _Failure as failure:
                failures.append(str(failure))
            except MemoryError:
                failures.append(f"{path}: there is not enough memory for it: use a smaller image")
            bar.update(1)
    if as_json:
        print_json({"backend": backend, "images": results, "failures": failures})
    else:
        for result in results:
            how = "already done" if result["skipped"] else f"{result['seconds']:.2f} s"
            count = result["keypoints"]
            found = f"{count:,} keypoint{'' if count == 1 else 's'}"
            if kind == "network":  # else the number was asked for
                found += f", density {result['density']:.3f}"
            click.echo(f"{result['image']}: {found}, {how} -> {result['file']}")
    report_failures(failures, len(paths))
    if not any(result["keypoints"] for result in results):
        click.echo(
            "no keypoint was found: the image is uniform, or the options leave none", err=True
        )
        raise click.exceptions.Exit(NOTHING_FOUND)


class _Failure(Exception):
    """One image cannot be worked on; whatever else is raised concerns all of them."""


def _outputs(
    path: Path, output: Path, file_format: str, pictures: Sequence[str]
) -> dict[str, Path]:
    """Return the files that are made of an image, by what they hold."""
    files = {"file": output / f"{path.stem}.{file_format}"}
    return files | {name: output / f"{path.stem}_{name}.jpg" for name in pictures}


def _detect_one(
    path: Path,
    detector: DeepDetect | PointDetector,
    selection: SelectionOptions | None,
    mask: np.ndarray | None,
    files: dict[str, Path],
    records: OutputRecords,
) -> dict[str, Any]:
    """Detect, save and draw the keypoints of one image unless it is done; return its numbers."""
    from .._shared.atomic import atomic_path
    from .._shared.errors import DeepDetectError, MissingExtraError, WeightsError
    from ..detector.detector import DeepDetect, find_keypoints
    from ..features.selection import SelectionOptions, select_keypoints
    from ..io.image import load_image
    from ..io.tables import save_keypoints
    from ..viz.draw import draw_best_keypoints, draw_dense_keypoints, draw_logits, save_picture

    paths = list(files.values())
    drawn = {name: file for name, file in files.items() if name != "file"}
    shown = {"file": files["file"], "pictures": drawn}
    try:
        # Another command may have done it meanwhile.
        done = records.find(path, paths)
        if done is not None and all(isinstance(done.get(n), int | float) for n in NUMBERS):
            return {"image": path, **{n: done[n] for n in NUMBERS}, **shown, "skipped": True}
        started = time.perf_counter()
        if drawn:
            rgb = load_image(path)
        if drawn and isinstance(detector, DeepDetect):  # the network is run once for both
            heatmap, logits = detector.heatmap_and_logits(rgb)
            keypoints = select_keypoints(
                heatmap, selection or SelectionOptions(), logits, ignore=mask
            )
        elif drawn:
            keypoints = find_keypoints(detector, rgb, selection, mask)
        else:
            # Nobody holds the image while keypoints are selected and written.
            keypoints = find_keypoints(detector, load_image(path), selection, mask)
        seconds = time.perf_counter() - started
    except (MissingExtraError, WeightsError):  # concern all images
        raise
    except DeepDetectError as error:
        named = str(error) if str(path) in str(error) else f"{path}: {error}"
        raise _Failure(named) from error
    records.begin(path, paths)
    with contextlib.ExitStack() as whole:  # all of them appear, or none
        made = {name: whole.enter_context(atomic_path(file)) for name, file in files.items()}
        save_keypoints(keypoints, made["file"])
        if drawn:
            save_picture(draw_best_keypoints(rgb, keypoints), made["keypoints"])
        if "dense" in drawn:
            save_picture(draw_dense_keypoints(rgb, keypoints), made["dense"])
            save_picture(draw_logits(logits), made["heatmap"])
    numbers = {
        "width": keypoints.image_size[0],
        "height": keypoints.image_size[1],
        "keypoints": len(keypoints),
        "density": round(keypoints.density, 6),
        "seconds": round(seconds, 4),
    }
    records.finish(path, paths, numbers)
    return {"image": path, **numbers, **shown, "skipped": False}
