"""Score weights and their calibration on the validation photographs of a training run.

    python benchmarks/validation_photographs.py PHOTOS --weights default [--weights espnet ...]

The views, the darkening and the labels are those of `deepdetect train --validation PHOTOS`. Each
photograph is scored in normal light, and darkened with the labels for low visibility. BCE and IoU
are means over photographs; calibration error (Naeini et al., 2015) and densities are computed over
all pixels.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from pathlib import Path

from deepdetect import DeepDetect
from deepdetect._shared.machine import processor_count
from deepdetect.io.image import load_image
from deepdetect_lab.evaluation.masks import Measured, mean_score, measure_heatmap
from deepdetect_lab.labels import LabelOptions
from deepdetect_lab.training.recipe import Stage, TrainingOptions
from deepdetect_lab.training.views import SourceImage, label_view, list_images, render


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--weights", action="append", required=True, help="name or file")
    parser.add_argument("--short-side", type=int, default=480, help="of the views, in pixels")
    parser.add_argument("--every", type=int, default=1, help="use every n-th photograph")
    arguments = parser.parse_args()
    options = options_of(arguments.short_side)
    images = list_images(arguments.photographs, options, ())[:: arguments.every]
    print(
        "| weights | light | photographs | BCE | IoU | calibration error | density "
        "| of the labels |\n"
        "|---|---|--:|--:|--:|--:|--:|--:|"
    )
    for weights in arguments.weights:
        score_one = partial(score, weights=weights, labels=options.labels)
        with ProcessPoolExecutor(processor_count()) as pool:
            scored = list(pool.map(score_one, images))
        for light, rows in zip(("normal", "darkened"), zip(*scored, strict=True), strict=True):
            found = mean_score(rows)
            values = found.loss, found.iou, found.calibration_error, found.density
            cells = " | ".join(f"{value:.4f}" for value in (*values, found.label_density))
            print(f"| {weights} | {light} | {len(rows)} | {cells} |")


def options_of(short_side_px: int) -> TrainingOptions:
    """Return the options of a training with validation images of a given shorter side."""
    return TrainingOptions(stages=(Stage(16, 1, 1),), short_sides=(short_side_px,))


def score(image: SourceImage, weights: str, labels: LabelOptions) -> list[Measured]:
    """Score the heat maps of a photograph in normal light and darkened, against their labels."""
    rgb = load_image(image.path)
    rows = []
    for view in image.validation_views:
        seen = render(rgb, view)
        heatmap = detector(weights).heatmap(seen)
        label = label_view(seen, view, labels)
        rows.append(measure_heatmap(heatmap, label))
    return rows


@cache
def detector(weights: str) -> DeepDetect:
    """Return a detector that does not scale images."""
    return DeepDetect(weights, resolution="native", threads=1)


if __name__ == "__main__":
    main()
