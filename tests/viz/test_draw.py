from __future__ import annotations

import numpy as np

from deepdetect.viz.draw import (
    draw_depth,
    draw_heatmap,
    draw_logits,
)


def test_heat_map_colours_are_viridis() -> None:
    from matplotlib import colormaps

    levels = np.linspace(0, 1, 256, dtype=np.float32)[None].repeat(16, 0)
    expected = colormaps["viridis"](levels)[..., :3] * 255
    assert np.abs(draw_heatmap(levels).astype(float) - expected).max() <= 2


def test_a_map_of_logits_is_not_saturated() -> None:
    logits = np.linspace(-12, 40, 200, dtype=np.float32)[None].repeat(20, 0)
    picture = draw_logits(logits)[:20]
    assert len(np.unique(picture[0], axis=0)) > 150
    flat = draw_logits(np.full((20, 30), -np.inf, np.float32))
    assert (flat[:20] == flat[0, 0]).all()


def test_a_depth_map_is_bright_where_it_is_near() -> None:
    depth = np.full((30, 60), np.nan, np.float32)
    depth[:, :20], depth[:, 40:] = 100, 900
    picture = draw_depth(depth, "mm")
    assert picture[15, 10].sum() > picture[15, 50].sum() + 100
    assert not picture[15, 30].any()
    assert draw_depth(np.full((30, 60), np.nan), "mm").shape[1] == 60
