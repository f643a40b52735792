from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect_lab.training.scenes import (
    SIDE_PX,
    Layer,
    View,
    correspond,
    draw_layers,
    render_layers,
)

SEEDS = range(12)


def files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def bilinear(image: np.ndarray, xy: np.ndarray) -> np.ndarray:
    column, row = np.floor(xy).astype(int).T
    x, y = (xy - np.floor(xy)).T
    above = image[row, column] * (1 - x) + image[row, column + 1] * x
    below = image[row + 1, column] * (1 - x) + image[row + 1, column + 1] * x
    return above * (1 - y) + below * y


@pytest.mark.parametrize("seed", SEEDS)
def test_both_positions_show_the_same_place_of_the_same_photograph(
    textures: Path, seed: int
) -> None:
    layers, scales, _ = draw_layers(np.random.default_rng(seed), files(textures))
    tops = [render_layers(layers, k, scales[k])[1] for k in range(2)]
    xy = np.random.default_rng(100 + seed).uniform(10, SIDE_PX - 11, (400, 2)).astype(np.float32)
    there, _, seen = correspond(layers, tops, xy)
    assert seen.sum() > 20
    columns, rows = np.meshgrid(*[np.arange(480, dtype=np.float32)] * 2)
    layer_of = tops[0][tuple(np.rint(xy[:, ::-1]).astype(int).T)]
    for number, layer in enumerate(layers):
        chosen = seen & (layer_of == number)
        for coordinate in (columns, rows):  # a photograph whose values are its coordinates
            first, second = (view.render(coordinate) for view in layer.views)
            places = bilinear(first, xy[chosen]), bilinear(second, there[chosen])
            np.testing.assert_allclose(*places, atol=0.25)


@pytest.mark.parametrize("seed", SEEDS)
def test_positions_and_derivatives_are_those_of_the_homography(textures: Path, seed: int) -> None:
    layers, scales, turn = draw_layers(np.random.default_rng(seed), files(textures))
    matrices = [view.matrix for view in layers[0].views]
    layer = Layer(layers[0].photograph, (View(matrices[0]), View(matrices[1])))  # no relief
    nothing = np.zeros((SIDE_PX, SIDE_PX), np.uint8)
    middle = np.full((1, 2), SIDE_PX / 2, np.float32)
    there, jacobians, _ = correspond([layer], [nothing, nothing], middle)
    h = np.linalg.inv(matrices[1]) @ matrices[0]
    x, y, w = h @ (*middle[0], 1)
    np.testing.assert_allclose(there[0], (x / w, y / w), atol=1e-3)
    expected = (h[:2, :2] - np.outer((x / w, y / w), h[2, :2])) / w
    np.testing.assert_allclose(jacobians[0], expected, atol=2e-3)
    # The views' scales and the turn, but for perspective and tilt.
    assert np.sqrt(np.linalg.det(expected)) == pytest.approx(scales[0] / scales[1], rel=0.3)
    skew = expected[1, 0] - expected[0, 1]
    turned = abs(np.arctan2(skew, np.trace(expected)))
    assert turned == pytest.approx(turn, abs=0.2)


def test_layers_in_front_hide_what_is_behind(textures: Path) -> None:
    drawn = (draw_layers(np.random.default_rng(k), files(textures)) for k in range(40))
    layers, scales, _ = next(each for each in drawn if len(each[0]) > 2)
    plain = [
        Layer(np.full((480, 480, 3), 10 * (k + 1), np.uint8), *layer[1:])
        for k, layer in enumerate(layers)
    ]
    image, top = render_layers(plain, 0, scales[0])
    clear = np.isin(image, [10.0 * (k + 1) for k in range(len(plain))])
    np.testing.assert_array_equal(image[clear], 10.0 * (top[clear] + 1))
    assert len(np.unique(top)) > 1
    xy = np.argwhere(clear)[::50, ::-1].astype(np.float32)
    _, _, seen = correspond(plain, [top, np.full_like(top, 9)], xy)  # the second hides all
    assert not seen.any()
