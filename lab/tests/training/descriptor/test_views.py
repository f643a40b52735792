from __future__ import annotations

from pathlib import Path

import numpy as np

from deepdetect_lab.training.descriptor.views import draw_pair, photograph_view
from deepdetect_lab.training.scenes import SIDE_PX


def files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def test_pairs_hold_their_keypoints_padded(textures: Path) -> None:
    drawn = [draw_pair(np.random.default_rng(k), files(textures)) for k in range(12)]
    pairs = [pair for pair in drawn if pair is not None]
    assert len(pairs) > 6
    for pair in pairs:
        assert pair.images.shape == (2, SIDE_PX, SIDE_PX)
        assert not any(np.any(each[~pair.valid]) for each in pair[1:6])
        places, sizes = pair.positions0[pair.valid], pair.sizes1[pair.valid]
        assert ((places > 5) & (places < SIDE_PX - 6)).all()
        assert ((sizes > 2.5) & (sizes < 32.5)).all()
    assert any(pair.zoom > 0.6 for pair in pairs)
    assert any(pair.turn > 1 for pair in pairs)


def test_light_changes_values_but_not_places() -> None:
    image = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    image[96:160, 64:128] = 0.8
    for seed in range(30):
        changed = photograph_view(np.random.default_rng(seed), image).astype(float)
        assert changed[110:146, 78:114].mean() > changed[110:146, 160:196].mean()
