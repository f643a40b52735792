"""HPatches sequences (Balntas et al., 2017): i_NAME change the light, v_NAME the viewpoint.

The layout is the public one: SCENE/1.ppm (or .png) to 6, SCENE/H_1_2 to H_1_6.
"""

from __future__ import annotations

from pathlib import Path

from .._shared.errors import ImageError
from .types import PlanarScene, load_planar_scene

ILLUMINATION, VIEWPOINT = "illumination", "viewpoint"
"""The kinds of scenes."""

SUFFIXES = (".ppm", ".png")
NOT_IN_D2NET_SUBSET = {
    *("i_contruction", "i_crownnight", "i_dc", "i_pencils", "i_whitebuilding"),
    *("v_artisans", "v_astronautis", "v_talent"),
}
"""The eight scenes with images beyond 1600x1200, which most papers leave out (D2-Net's list)."""


def load_hpatches(folder: str | Path) -> list[PlanarScene]:
    """List the scenes that are there, folders i_* and v_*: 116 in the whole set."""
    root = Path(folder)
    found = [*sorted(root.glob("i_*")), *sorted(root.glob("v_*"))]
    scenes = [path for path in found if path.is_dir()]
    if not scenes:
        raise ImageError(
            f"there are no HPatches scenes in {folder}: it must hold folders i_NAME and v_NAME"
        )
    images = [f"{number}" for number in range(1, 7)]
    homographies = [f"H_1_{number}" for number in range(2, 7)]
    layout = "a scene has images 1 to 6"
    return [
        load_planar_scene(
            path,
            images,
            homographies,
            SUFFIXES,
            layout,
            ILLUMINATION if path.name.startswith("i_") else VIEWPOINT,
        )
        for path in scenes
    ]


def is_illumination(scene: PlanarScene) -> bool:
    """Whether a scene changes the light; the others change the viewpoint."""
    return scene.name.startswith("i_")


def in_d2net_subset(scene: PlanarScene) -> bool:
    """Whether a scene is one of the 108 of the D2-Net subset, on which most papers report."""
    return scene.name not in NOT_IN_D2NET_SUBSET
