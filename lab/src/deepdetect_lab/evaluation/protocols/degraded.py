"""The standard protocol with a dark or blurred second image in each pair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from deepdetect._shared.records import file_digest
from deepdetect.io.image import load_image
from deepdetect.io.picture_file import save_picture

from ...datasets.degradation import DEGRADATIONS, Degradation, degrade
from ...datasets.planar import PlanarPair
from ..options import BenchmarkOptions
from ..report import Section
from ..run import Run
from .standard import standard_section

TEXT = (
    "Dark and blurred image copies are simulated in linear light with fixed random numbers. "
    "With 1/4 or 1/8 of the light, white gives 2,500 or 1,250 electrons instead of 10,000. "
    "Shot noise is Poisson noise, read noise has a standard deviation of 3 electrons, and the "
    "result has 8 bits. The direction of motion blur is random for each image. Only the second "
    "image of each pair is degraded."
)


def degraded_sections(
    run: Run, options: BenchmarkOptions, pairs: Sequence[PlanarPair], key: str, title: str
) -> list[Section]:
    """Measure and tabulate all features of the standard protocol, with each degradation."""
    sections = []
    for name, degradation in DEGRADATIONS.items() if "degraded" in options.protocols else ():
        made = (
            run.attempt(f"{pair.name}, {name}", degraded_pair, pair, degradation, run.files_folder)
            for pair in pairs
        )
        worse = [pair for pair in made if pair is not None]
        named = f"{key}_{name}", f"{title}, {degradation.title}"
        sections.append(standard_section(run, options, worse, *named, TEXT))
    return sections


def degraded_pair(pair: PlanarPair, degradation: Degradation, folder: Path) -> PlanarPair:
    """Return a pair with a degraded copy as second image, created in a folder if missing."""
    digest = file_digest(pair.second)[:16]
    path = folder / "degraded" / f"{digest}-{degradation.name}-v{degradation.version}.png"
    if not path.exists():
        save_picture(degrade(load_image(pair.second), degradation), path)
    return replace(pair, second=path)
