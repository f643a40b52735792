"""The two badly visible pairs of the paper, dusty and smoky; nothing moves between the images."""

from __future__ import annotations

from pathlib import Path

from .types import PlanarScene, load_planar_scene

SCENES = ("dusty", "smoky")
SUFFIXES = (".png", ".bmp")


def load_low_visibility(folder: str | Path) -> list[PlanarScene]:
    """List the two scenes, of two images each: SCENE/img1, SCENE/img2 (.png or .bmp), H1to2p."""
    layout = "the folder must hold dusty and smoky"
    folders = [Path(folder) / name for name in SCENES]
    return [load_planar_scene(p, ("img1", "img2"), ("H1to2p",), SUFFIXES, layout) for p in folders]
