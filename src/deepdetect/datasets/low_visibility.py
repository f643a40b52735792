"""The two badly visible pairs of the paper, dusty and smoky; nothing moves between the images."""

from __future__ import annotations

from pathlib import Path

from .._shared.errors import ImageError
from .types import PlanarScene, read_homography

SCENES = ("dusty", "smoky")
ENDINGS = (".png", ".bmp")


def load_low_visibility(folder: str | Path) -> list[PlanarScene]:
    """List the two scenes, of two images each: SCENE/img1, SCENE/img2 (.png or .bmp), H1to2p.

    Raises:
        ImageError: a file is missing.
    """
    scenes = []
    for name in SCENES:
        root = Path(folder) / name
        images = []
        for number in (1, 2):
            found = [p for e in ENDINGS if (p := root / f"img{number}{e}").exists()]
            if not found:
                raise ImageError(
                    f"there is no img{number} in {root}: the folder must hold dusty and smoky"
                )
            images.append(found[0])
        scenes.append(PlanarScene(name, tuple(images), (read_homography(root / "H1to2p"),)))
    return scenes
