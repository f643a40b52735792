from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deepdetect._shared.errors import OptionError
from deepdetect.detector import heatmap
from deepdetect.detector.heatmap import HeatmapOptions, compute_maps


def compute_heatmap_and_logits(rgb: np.ndarray, *arguments: Any) -> tuple[np.ndarray, np.ndarray]:
    return compute_maps(rgb, *arguments).both()


def compute_heatmap(rgb: np.ndarray, *arguments: Any) -> np.ndarray:
    return compute_maps(rgb, *arguments).both()[0]


RGB = np.random.default_rng(11).integers(0, 256, (61, 90, 3), dtype=np.uint8)


class Recorder:
    """A network that keeps what it was shown; its answer differs between the channels."""

    def __init__(self) -> None:
        self.shown: list[np.ndarray] = []

    def __call__(self, planes: np.ndarray) -> np.ndarray:
        self.shown.append(planes.copy())
        return answer(planes)


def respond(planes: np.ndarray) -> np.ndarray:
    red, green, blue = planes[0]
    return (0.6 * red + 0.3 * green + 0.1 * blue**2).astype(np.float32)[None, None]


def to_logits(probability: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        wide = probability.astype(np.float64)
        return (np.log(wide) - np.log1p(-wide)).astype(np.float32)


def answer(planes: np.ndarray) -> np.ndarray:
    return to_logits(respond(planes))


def refuse(planes: np.ndarray) -> np.ndarray:
    raise AssertionError("the network was run")


@given(height=st.integers(16, 41), width=st.integers(16, 41))
def test_an_image_of_any_size_is_padded_with_its_border(height: int, width: int) -> None:
    rgb = RGB[:height, :width]
    network = Recorder()
    heatmap = compute_heatmap(rgb, network)
    (planes,) = network.shown
    assert planes.dtype == np.float32
    assert planes.shape[:2] == (1, 3)
    full_height, full_width = planes.shape[2:]
    assert full_height % 8 == 0
    assert full_width % 8 == 0
    assert 0 <= full_height - height < 8
    assert 0 <= full_width - width < 8
    rows = np.minimum(np.arange(full_height), height - 1)
    columns = np.minimum(np.arange(full_width), width - 1)
    expected = (rgb[rows][:, columns] / 255).transpose(2, 0, 1)
    np.testing.assert_allclose(planes[0], expected, atol=1e-7)
    assert heatmap.shape == (height, width)
    assert heatmap.dtype == np.float32
    expected = respond(planes)[0, 0, :height, :width]
    np.testing.assert_allclose(heatmap, expected, rtol=1e-5, atol=1e-7)
    again, logits = compute_heatmap_and_logits(rgb, network)
    np.testing.assert_array_equal(again, heatmap)
    np.testing.assert_array_equal(logits, to_logits(expected))


@pytest.mark.parametrize("side", [16, 104])
@pytest.mark.parametrize("channels", ["rgb", "bgr"])
def test_a_squashed_image(side: int, channels: str) -> None:
    shown = RGB if channels == "rgb" else RGB[:, :, [2, 1, 0]]
    square = cv2.resize(np.ascontiguousarray(shown), (side, side), interpolation=cv2.INTER_CUBIC)
    small = respond((square.transpose(2, 0, 1)[None] / 255).astype(np.float32))[0, 0]
    expected = cv2.resize(small, (90, 61), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    heatmap, logits = compute_heatmap_and_logits(RGB, answer, HeatmapOptions(side, channels))
    assert heatmap.dtype == logits.dtype == np.float32
    np.testing.assert_allclose(heatmap, expected, atol=1e-5)
    expected = cv2.resize(to_logits(small), (90, 61), interpolation=cv2.INTER_CUBIC)
    np.testing.assert_allclose(logits, expected, atol=1e-4)


def test_a_squashed_map_stays_in_range() -> None:
    def checkers(planes: np.ndarray) -> np.ndarray:
        # Cubic interpolation of this overshoots on both sides.
        rows, columns = np.indices(planes.shape[2:])
        return to_logits(((rows // 2 + columns // 2) % 2).astype(np.float32)[None, None])

    heatmap = compute_heatmap(RGB, checkers, HeatmapOptions(32))
    assert heatmap.min() == 0
    assert heatmap.max() == 1


@pytest.mark.parametrize(("pixels", "seen"), [(48 * 64, (48, 64)), (12 * 16, (16, 16))])
def test_auto_is_native_up_to_a_number_of_pixels(
    pixels: int, seen: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(heatmap, "MAX_AUTO_PIXELS", pixels)
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, 32:] = 200
    shapes = []

    def network(planes: np.ndarray) -> np.ndarray:
        shapes.append(planes.shape[2:])
        return respond(planes)

    found = compute_heatmap(rgb, network, HeatmapOptions("auto"))
    assert shapes == [seen]
    assert found.shape == (48, 64)
    assert found[24, 60] > found[24, 4]
    if pixels == rgb[:, :, 0].size:
        np.testing.assert_array_equal(
            found, compute_heatmap(rgb, respond, HeatmapOptions("native"))
        )


@pytest.mark.parametrize("resolution", ["native", 40])
def test_bgr_is_the_swapped_image(resolution: str | int) -> None:
    swapped = np.ascontiguousarray(RGB[:, :, ::-1])
    ours = compute_heatmap(RGB, answer, HeatmapOptions(resolution, "bgr"))
    np.testing.assert_array_equal(
        ours, compute_heatmap(swapped, answer, HeatmapOptions(resolution))
    )
    assert np.abs(ours - compute_heatmap(RGB, answer, HeatmapOptions(resolution))).max() > 0.1


def test_a_constant_image_is_not_shown_to_the_network() -> None:
    for resolution in ("native", 40):
        rgb = np.broadcast_to(np.array((12, 200, 77), np.uint8), (17, 23, 3))
        heatmap = compute_heatmap(rgb, refuse, HeatmapOptions(resolution))
        assert (heatmap.shape, heatmap.dtype) == ((17, 23), np.float32)
        assert not heatmap.any()
    other = rgb.copy()
    other[7, 3, 1] += 1
    assert compute_heatmap(other, answer).any()


@pytest.mark.parametrize(
    "options",
    [
        {"resolution": "nativ"},
        {"resolution": 8},
        {"resolution": 100},
        {"network_channels": "brg"},
        {"tta": "flips"},
        {"resolution": "native", "tile_megapixels": 0.5},
    ],
)
def test_wrong_options(options: dict[str, object]) -> None:
    with pytest.raises(OptionError):
        HeatmapOptions(**options)


# Test-time augmentation.


def uneven(planes: np.ndarray) -> np.ndarray:
    """Answer differently at the left and the top than at the right and the bottom."""
    logits = 4 * planes.mean(1, keepdims=True) - 2
    logits[..., 1:, :] += planes[:, :1, :-1]
    logits[..., 1:] -= 2 * planes[:, 1:2, :, :-1]
    return logits.astype(np.float32)


def test_flips_take_the_mean_of_eight_copies() -> None:
    rgb = RGB[:48, :64]
    shown = Recorder()
    logits = compute_heatmap_and_logits(rgb, shown, HeatmapOptions(tta="flip"))[1]
    assert len({planes.tobytes() for planes in shown.shown}) == len(shown.shown) == 8
    assert sorted(planes.shape[2:] for planes in shown.shown) == [(48, 64)] * 4 + [(64, 48)] * 4
    expected = compute_heatmap_and_logits(rgb, answer)[1]  # which no flip changes
    np.testing.assert_allclose(logits, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("turns", "flipped"), [(0, True), (1, False), (3, True)])
def test_a_turned_image_gives_the_turned_map(turns: int, flipped: bool) -> None:
    def turn(map_: np.ndarray) -> np.ndarray:
        turned = np.rot90(map_, turns)
        return np.ascontiguousarray(turned[:, ::-1] if flipped else turned)

    rgb = RGB[:48, :64]
    options = HeatmapOptions(tta="flip")
    for wanted in (0, 1):
        map_ = compute_heatmap_and_logits(rgb, uneven, options)[wanted]
        of_turned = compute_heatmap_and_logits(turn(rgb), uneven, options)[wanted]
        np.testing.assert_allclose(of_turned, turn(map_), atol=1e-5)
    without = compute_heatmap(turn(rgb), uneven) - turn(compute_heatmap(rgb, uneven))
    assert np.abs(without).max() > 0.01


@pytest.mark.parametrize(("side", "expected"), [(64, 0), (80, 1)])
def test_the_network_of_a_large_image_gives_its_memory_back(
    side: int, expected: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Network:
        released = 0

        def __call__(self, image: np.ndarray) -> np.ndarray:
            return answer(image)

        def release_memory(self) -> None:
            self.released += 1

    monkeypatch.setattr("deepdetect.detector.heatmap.MAX_AUTO_PIXELS", 1024)
    monkeypatch.setattr("deepdetect.detector.heatmap.RELEASE_PIXELS", 64 * 64)
    network = Network()
    rgb = np.random.default_rng(0).integers(0, 256, (side, side, 3)).astype(np.uint8)
    compute_heatmap(rgb, network)
    assert network.released == expected
