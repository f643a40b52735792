from __future__ import annotations

import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect import DeepDetect, Keypoints
from deepdetect._shared.errors import OptionError
from deepdetect.detector import HeatmapOptions, heatmap, tiling
from deepdetect.detector import detector as detector_module
from deepdetect.detector.pretrained import pretrained_weights
from deepdetect.detector.tiling import TiledNetwork, open_tiled
from deepdetect.features.selection import select_from_maps


@pytest.fixture(scope="module")
def strip(photo: np.ndarray) -> np.ndarray:
    """A long image, in which no tile sees all, whose sides are no multiples of 8."""
    return np.ascontiguousarray(np.tile(photo[:75], (1, 10, 1))[:, :2551])


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(backend="onnxruntime", resolution="native", threads=1)


def open_bundled(weights: str = "default") -> TiledNetwork:
    network = open_tiled(pretrained_weights(weights), threads=1)
    assert network is not None
    return network


@pytest.mark.parametrize(("weights", "upright"), [("default", False), ("dense", True)])
def test_tiles_give_the_logits_of_the_whole(weights: str, upright: bool, strip: np.ndarray) -> None:
    part = strip[:, :1000]
    rgb = np.ascontiguousarray(part.swapaxes(0, 1) if upright else part)
    whole = DeepDetect(weights, backend="onnxruntime", resolution="native", threads=1)
    expected = whole.heatmap_and_logits(rgb)[1]
    found = open_bundled(weights)(rgb, tile_megapixels=0.05)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() < 1e-3
    assert np.mean(np.abs(found - expected)) < 1e-5


@pytest.mark.parametrize("shift", [8, 16])
def test_a_shift_by_the_stride_changes_nothing_far_from_the_border(
    shift: int, detector: DeepDetect, strip: np.ndarray
) -> None:
    whole = detector.heatmap_and_logits(strip)[1][:, shift:]
    shifted = detector.heatmap_and_logits(np.ascontiguousarray(strip[:, shift:]))[1]
    difference = np.abs(shifted - whole).max(0)
    assert difference[1744:].max() < 1e-4
    assert difference[:32].max() > 0.1  # the zeros that pad the layers are seen from afar


def test_tiles_overlap_by_what_is_needed(
    strip: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = strip[:, :900]
    expected = open_bundled()(part, tile_megapixels=0.05)
    for name in ("START_MARGIN_PX", "BLOCK_MARGIN", "END_MARGIN_PX"):
        with monkeypatch.context() as patch:
            patch.setattr(tiling, name, getattr(tiling, name) // 4)
            found = open_bundled()(part, tile_megapixels=0.05)
        assert np.abs(found - expected).max() > 0.01


def test_images_larger_than_the_memory_are_tiled(
    detector: DeepDetect, strip: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = strip[:, :1000]
    expected, expected_map = detector.detect(part), detector.heatmap(part)
    monkeypatch.setattr(heatmap, "available_memory", lambda: part[..., 0].size * 140)
    monkeypatch.setattr(tiling, "DEFAULT_TILE_MEGAPIXELS", 0.05)
    monkeypatch.setattr(detector._network, "_session", None)  # so that it cannot be run whole
    found = detector.detect(part)
    assert np.mean(np.isin(found.xy @ [1, 10_000], expected.xy @ [1, 10_000])) > 0.999
    assert abs(len(found) - len(expected)) < 0.001 * len(expected)
    map_ = detector.heatmap(part)
    np.testing.assert_allclose(map_, expected_map, atol=1e-4)


def test_tiles_of_a_given_size(
    detector: DeepDetect, strip: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    areas = []

    class Tiled:
        def __call__(self, rgb: np.ndarray, area: float | None) -> np.ndarray:
            areas.append(area)
            return np.zeros(rgb.shape[:2], np.float32)

    monkeypatch.setattr(heatmap, "MIN_TILE_MEGAPIXELS", 0.01)
    monkeypatch.setattr(heatmap, "open_tiled", lambda path, threads: Tiled())
    for size, expected in ((0.1, [0.1]), (1.0, [])):
        areas.clear()
        options = HeatmapOptions("native", tile_megapixels=size)
        detector.configured(options).heatmap(strip)
        assert areas == expected


def test_other_networks_are_not_tiled(onnx_file: Callable[..., Path]) -> None:
    assert open_tiled(onnx_file()) is None


def test_a_size_of_tiles_is_never_ignored(photo: np.ndarray) -> None:
    large = np.tile(photo, (6, 6, 1))
    with pytest.raises(OptionError, match="resolution='native'"):
        DeepDetect(tile_megapixels=2.0)
    pytest.importorskip("torch", reason="needs torch, which is for training only")
    torch_weights = pretrained_weights("default", ".safetensors")
    with pytest.raises(OptionError, match="cannot be run in tiles"):
        DeepDetect(
            torch_weights, backend="torch", resolution="native", tile_megapixels=2.0
        ).heatmap(large)


def test_images_in_bfloat16_are_run_whole(
    photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tiles are computed in float32, so that keypoints would depend on the memory."""
    openvino = pytest.importorskip("openvino")
    # The instructions are not needed for that.
    monkeypatch.setattr(openvino.Core, "get_property", lambda *_: ["FP32", "BF16"])
    options: dict[str, object] = {"resolution": "native", "precision": "bfloat16", "threads": 2}
    with pytest.raises(OptionError, match=r"cannot be run in tiles: .* in float32"):
        DeepDetect(tile_megapixels=1.5, **options).heatmap(np.tile(photo, (6, 6, 1)))
    small, whole = photo[:96, :128], DeepDetect(**options)
    expected = whole.heatmap(small)
    monkeypatch.setattr(heatmap, "available_memory", lambda: 0)
    monkeypatch.setattr(heatmap, "open_tiled", None)
    np.testing.assert_array_equal(whole.heatmap(small), expected)


@pytest.mark.parametrize("resolution", ["auto", "native"])
def test_nobody_holds_the_image_while_keypoints_are_selected(
    resolution: str, photo: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    images: list[weakref.ref[np.ndarray]] = []
    held = []

    def load(_: object, **__: object) -> np.ndarray:
        rgb = photo[:64, :96].copy()
        images.append(weakref.ref(rgb))
        return rgb

    def select(*args: Any) -> Keypoints:
        held.append(images[0]() is not None)
        return select_from_maps(*args)

    monkeypatch.setattr(heatmap, "MAX_AUTO_PIXELS", 2048)
    monkeypatch.setattr(detector_module, "load_image", load)
    monkeypatch.setattr(detector_module, "select_from_maps", select)
    found = DeepDetect(backend="onnxruntime", resolution=resolution).detect("photo.jpg")
    assert len(found) > 100
    assert held == [False]
