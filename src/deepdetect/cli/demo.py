"""`deepdetect demo`: the main job on a real stereo pair with a known truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .shared import (
    PATH,
    detector_options,
    json_option,
    make_detector,
    print_json,
    print_table,
    seconds_rows,
)


@click.command(short_help="Detect and match a real stereo pair, and judge the matches.")
@click.option(
    "-o",
    "--output",
    type=PATH,
    default=Path("demo-output"),
    show_default=True,
    help="Folder for the pictures.",
)
@detector_options
@json_option
def demo(output: Path, as_json: bool, **values: Any) -> None:
    """Detect and match the Motorcycle stereo pair, and judge the matches by its true disparity.

    The photographs (Middlebury 2014) come with the package scikit-image. Random points
    of the same number stand beside ours: a match by chance is not to be mistaken for skill.
    """
    from ..datasets import load_stereo_pair
    from ..evaluation.stereo_demo import run_demo

    detector = make_detector(values)
    result = run_demo(load_stereo_pair("motorcycle"), detector, output)
    if as_json:
        print_json(result.numbers())
        return
    print_table(
        [
            ("network", f"{detector.weights.name}, {detector.backend}"),
            *result.rows(),
            *seconds_rows(result.seconds),
            ("pictures", ", ".join(str(path) for path in result.pictures)),
        ],
        "The Motorcycle stereo pair (two photographs of 741x500 pixels)",
    )
