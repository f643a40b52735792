"""The standard protocol on pairs whose second image is darkened or blurred."""

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
from .standard import standard_sections

TEXT = (
    "The second image of each pair is replaced by a darkened or blurred copy; the first image is "
    "unchanged. Copies are simulated in linear light, with random numbers that are the same in "
    "each run. In full light a white pixel receives 10,000 electrons, and in dark copies 1/4 or "
    "1/8 of them, with Poisson shot noise and a read noise of 3 electrons (standard deviation). "
    "Copies have 8 bits. Each image has its own random direction of motion blur."
)


def degraded_sections(
    run: Run, options: BenchmarkOptions, pairs: Sequence[PlanarPair], key: str, title: str
) -> list[Section]:
    """Run the standard protocol with each degradation, if "degraded" is among the protocols."""
    sections: list[Section] = []
    standard = replace(options, protocols=("standard",))
    for name, degradation in DEGRADATIONS.items() if "degraded" in options.protocols else ():
        made = (
            run.attempt(f"{pair.name}, {name}", degraded_pair, pair, degradation, run.files_folder)
            for pair in pairs
        )
        worse = [pair for pair in made if pair is not None]
        named = f"{key}_{name}", f"{title}, {degradation.title}"
        sections += standard_sections(run, standard, worse, *named, TEXT)
    return sections


def degraded_pair(pair: PlanarPair, degradation: Degradation, folder: Path) -> PlanarPair:
    """Replace the second image of a pair by its degraded copy; make the file if it is missing."""
    digest = file_digest(pair.second)[:16]
    path = folder / "degraded" / f"{digest}-{degradation.name}-v{degradation.version}.png"
    if not path.exists():
        save_picture(degrade(load_image(pair.second), degradation), path)
    return replace(pair, second=path)
