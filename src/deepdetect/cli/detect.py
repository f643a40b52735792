"""`deepdetect detect`: keypoints of photographs."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

from ._generated import generated_command, given_only
from ._options import (
    DETECTOR,
    PATH,
    SELECTION,
    expand_images,
    format_option,
    json_option,
    make_detector,
    output_option,
    pictures_option,
    print_json,
    report_failures,
)


@generated_command(SELECTION, DETECTOR, short_help="Keypoints of photographs.")
@click.argument("images", type=PATH, nargs=-1, required=True)
@output_option
@click.option(
    "--ignore",
    type=PATH,
    help="Mask image of the same size: no keypoints where it is bright.",
)
@format_option
@pictures_option
@json_option
def detect(
    images: tuple[Path, ...],
    output: Path,
    ignore: Path | None,
    file_format: str,
    pictures: bool,
    as_json: bool,
    **values: Any,
) -> None:
    """Detect the keypoints of IMAGES (files or folders).

    Writes for each image STEM.npz (or .csv) with the positions and scores, and the pictures
    STEM_keypoints.png and STEM_heatmap.png. With --max-keypoints they are the best keypoints of
    all scales; without, all pixels over the threshold.

    \b
    deepdetect detect photo.jpg
    deepdetect detect photos/ -o keypoints --max-keypoints 2048 --spread grid
    deepdetect detect photo.jpg --density 0.1 --format csv
    """
    from .._shared.errors import DeepDetectError
    from .._shared.progress import progress
    from ..io.masks import load_mask

    paths = expand_images(images, output)
    mask = load_mask(ignore) if ignore is not None else None
    detector = make_detector(values)
    selection = {**given_only(values), "ignore": mask}
    results: list[dict[str, Any]] = []
    failures = []
    with progress(len(paths), "detecting", "image", quiet=len(paths) == 1) as bar:
        for path in paths:
            try:
                results.append(
                    _detect_one(path, detector, selection, output, file_format, pictures)
                )
            except DeepDetectError as error:
                failures.append(str(error))
            except MemoryError:
                failures.append(f"there is not enough memory for {path}: use a smaller image")
            bar.update(1)
    if as_json:
        print_json({"backend": detector.backend, "images": results, "failures": failures})
    else:
        for result in results:
            click.echo(
                f"{result['image']}: {result['keypoints']:,} keypoints, "
                f"density {result['density']:.3f}, {result['seconds']:.2f} s -> {result['file']}"
            )
    report_failures(failures, len(paths))


def _detect_one(
    path: Path,
    detector: Any,
    selection: dict[str, Any],
    output: Path,
    file_format: str,
    pictures: bool,
) -> dict[str, Any]:
    """Detect, save and draw the keypoints of one image; return its numbers."""
    from ..io.image import load_image
    from ..io.tables import save_keypoints
    from ..viz.draw import add_caption, draw_heatmap, draw_keypoints, save_picture

    rgb = load_image(path)
    started = time.perf_counter()
    if pictures:
        keypoints, heatmap = detector.detect(rgb, **selection, return_heatmap=True)
    else:
        keypoints = detector.detect(rgb, **selection)
    seconds = time.perf_counter() - started
    file = output / f"{path.stem}.{file_format}"
    save_keypoints(keypoints, file)
    drawn = {}
    if pictures:
        caption = f"{len(keypoints):,} keypoints, density {keypoints.density:.3f}"
        for name, picture in (
            ("keypoints", add_caption(draw_keypoints(rgb, keypoints), caption)),
            ("heatmap", draw_heatmap(heatmap)),
        ):
            drawn[name] = output / f"{path.stem}_{name}.png"
            save_picture(picture, drawn[name])
    return {
        "image": path,
        "width": rgb.shape[1],
        "height": rgb.shape[0],
        "keypoints": len(keypoints),
        "density": round(keypoints.density, 6),
        "seconds": round(seconds, 4),
        "file": file,
        "pictures": drawn,
    }
