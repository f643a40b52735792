"""`deepdetect label`: fusion masks of photographs."""

from __future__ import annotations

from pathlib import Path

import click

from .shared import (
    PATH,
    chosen_label_settings,
    expand_images,
    json_option,
    label_settings_option,
    print_json,
    report_failures,
    workers_option,
)


@click.command(short_help="Training masks from nine classical detectors.")
@click.argument("images", type=PATH, nargs=-1, required=True)
@click.option("-o", "--output", type=PATH, required=True, help="Folder for the masks.")
@click.option(
    "--detectors",
    metavar="NAME,NAME,...",
    help="Some of sift, orb, brisk, fast, agast, harris, shi-tomasi, canny, sobel.  [default: all]",
)
@label_settings_option
@click.option(
    "--visibility",
    default="auto",
    show_default=True,
    help="Detector settings: normal, low, or auto: low when the luma of an image spans fewer "
    "than 64 grey levels from the 1st to the 99th percentile.",
)
@click.option("--explain", is_flag=True, help="Write STEM_explain.png too (the paper's Figure 4).")
@click.option("--overwrite", is_flag=True, help="Make masks anew that are already there.")
@workers_option
@json_option
def label(
    images: tuple[Path, ...],
    output: Path,
    detectors: str | None,
    label_settings: str | None,
    visibility: str,
    explain: bool,
    overwrite: bool,
    workers: int | None,
    as_json: bool,
) -> None:
    """Mark the keypoints and edges of IMAGES (files or folders) by nine classical detectors.

    Writes a 1-bit PNG mask STEM.png for each image: white where one of the detectors
    marks the pixel. What is already done is skipped.

    \b
    deepdetect label photos/ -o masks
    deepdetect label photo.jpg -o masks --detectors fast,sobel --explain
    """
    from .._shared.progress import progress
    from ..labels import LabelOptions
    from ..labels.batch import LabelTask, check_outputs, label_files, pending

    settings = chosen_label_settings(detectors, label_settings)
    options = LabelOptions(settings.detectors, visibility, settings.changes)
    tasks = [
        LabelTask(
            path,
            output / f"{path.stem}.png",
            output / f"{path.stem}_explain.png" if explain else None,
            options,
        )
        for path in expand_images(images, output)
    ]
    check_outputs(tasks)
    left = tasks if overwrite else pending(tasks)
    with progress(len(left), "labelling", "image") as bar:
        reports = label_files(left, workers, lambda report: bar.update(1))
    done = [report for report in reports if report.error is None]
    failures = [report.error for report in reports if report.error is not None]
    mean = sum(report.density for report in done) / len(done) if done else None
    low = sum(report.visibility == "low" for report in done)
    if as_json:
        print_json(
            {
                "labelled": [
                    {
                        "image": report.image,
                        "mask": report.mask,
                        "visibility": report.visibility,
                        "density": round(report.density, 6),
                    }
                    for report in sorted(done, key=lambda report: str(report.image))
                ],
                "skipped": len(tasks) - len(left),
                "mean_density": mean,
                "failures": failures,
            }
        )
    else:
        text = f"{len(done)} labelled, {len(tasks) - len(left)} already done"
        if done:
            text += f"; mean density {mean:.3f}, {low} of low visibility"
        click.echo(f"{text} -> {output}")
    report_failures(failures, len(tasks))
