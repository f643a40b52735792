"""Write the files of a reconstruction of two images."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..io.depth import save_depth_npz, save_depth_png
from ..io.picture_file import save_picture
from ..io.point_cloud import POINT_CLOUD_WRITERS, save_point_cloud
from ..viz.draw import draw_depth
from .result import Reconstruction

ENDINGS = (*POINT_CLOUD_WRITERS, "_depth.png", "_depth.npz", "_depth.jpg", ".json")


def save_reconstruction(
    found: Reconstruction, paths: Mapping[str, Path], title: str, **values: Any
) -> dict[str, Any]:
    """Write a file for each of `ENDINGS`; return what the JSON contains, including `values`."""
    started = time.perf_counter()
    summary = found.summary()
    notes = {
        "title": title,
        "pair": "rectified" if found.rectified else "not rectified",
        "calibration": found.calibration.source,
        "scale": summary["scale"],
    }
    for ending in POINT_CLOUD_WRITERS:
        save_point_cloud(found.cloud, paths[ending], notes)
    depth = found.depth_map()
    stored = save_depth_png(depth, paths["_depth.png"], found.unit)
    arrays = {} if found.disparity is None else {"disparity": found.disparity_map()}
    save_depth_npz(depth, paths["_depth.npz"], found.unit, matched=found.matched_map(), **arrays)
    save_picture(draw_depth(depth, found.unit), paths["_depth.jpg"])
    summary["seconds"]["files"] = round(time.perf_counter() - started, 4)
    numbers = {**summary, "depth_png": stored, **values}
    text = json.dumps(numbers, indent=2, default=str) + "\n"
    paths[".json"].write_text(text, encoding="utf-8")
    return numbers
