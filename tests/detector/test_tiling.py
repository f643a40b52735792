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
from deepdetect.detector.tiling import open_tiled
from deepdetect.features.selection import select_from_maps


@pytest.fixture(scope="module")
def strip(photo: np.ndarray) -> np.ndarray:
    """A long image whose sides are no multiples of 8."""
    return np.ascontiguousarray(np.tile(photo[:75], (1, 4, 1))[:, :1003])


@pytest.fixture
def detector(fast_files: tuple[Path, Path]) -> DeepDetect:
    return DeepDetect(fast_files[0], backend="onnxruntime", resolution="native", threads=1)


def logits_in_tiles(path: Path, rgb: np.ndarray, megapixels: float) -> np.ndarray:
    network = open_tiled(path, threads=1)
    assert network is not None
    return network(rgb, megapixels)


@pytest.mark.parametrize("upright", [False, True])
@pytest.mark.parametrize("megapixels", [0.009, 0.02, 0.05])
def test_tiles_give_the_logits_of_the_whole(
    megapixels: float, upright: bool, detector: DeepDetect, strip: np.ndarray
) -> None:
    rgb = np.ascontiguousarray(strip.swapaxes(0, 1) if upright else strip)
    expected = detector.heatmap_and_logits(rgb)[1]
    found = logits_in_tiles(detector.weights, rgb, megapixels)
    assert expected.std() > 0.1
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_tiles_overlap_by_what_is_needed(
    detector: DeepDetect, strip: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = detector.heatmap_and_logits(strip)[1]
    monkeypatch.setattr(tiling, "MARGIN", 3)
    found = logits_in_tiles(detector.weights, strip, 0.02)
    assert np.abs(found - expected).max() > 1e-4


def test_images_larger_than_the_memory_are_tiled(
    detector: DeepDetect, strip: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = detector.heatmap(strip)
    memory = strip[..., 0].size * (tiling.BYTES_PER_PIXEL - 1)
    monkeypatch.setattr(heatmap, "available_memory", lambda: memory)
    monkeypatch.setattr(tiling, "DEFAULT_TILE_MEGAPIXELS", 0.05)
    monkeypatch.setattr(detector._network, "_session", None)  # so that it cannot be run whole
    np.testing.assert_allclose(detector.heatmap(strip), expected, atol=1e-5)


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
    for size, expected in ((0.05, [0.05]), (1.0, [])):
        areas.clear()
        options = HeatmapOptions("native", tile_megapixels=size)
        detector.configured(options).heatmap(strip)
        assert areas == expected


def test_other_networks_are_not_tiled(onnx_file: Callable[..., Path]) -> None:
    assert open_tiled(onnx_file()) is None
    assert open_tiled(pretrained_weights("espnet")) is None


def test_a_size_of_tiles_is_never_ignored(photo: np.ndarray) -> None:
    large = np.tile(photo, (6, 6, 1))
    with pytest.raises(OptionError, match="resolution="):
        DeepDetect(tile_megapixels=2.0)
    with pytest.raises(OptionError, match="cannot be run in tiles"):
        DeepDetect("espnet", resolution="native", tile_megapixels=2.0).heatmap(large)


def test_images_in_bfloat16_are_run_whole(
    photo: np.ndarray, fast_files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tiles are computed in float32, so that keypoints would depend on the memory."""
    openvino = pytest.importorskip("openvino")
    # The instructions are not needed for that.
    monkeypatch.setattr(openvino.Core, "get_property", lambda *_: ["FP32", "BF16"])
    options: dict[str, object] = {"resolution": "native", "precision": "bfloat16", "threads": 2}
    with pytest.raises(OptionError):
        DeepDetect(fast_files[0], tile_megapixels=1.5, **options).heatmap(np.tile(photo, (6, 6, 1)))
    small, whole = photo[:96, :128], DeepDetect(fast_files[0], **options)
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

    def load(*_: object) -> np.ndarray:
        rgb = photo[:64, :96].copy()
        images.append(weakref.ref(rgb))
        return rgb

    def select(*args: Any) -> Keypoints:
        held.append(images[0]() is not None)
        return select_from_maps(*args)

    monkeypatch.setattr(heatmap, "MAX_AUTO_PIXELS", 2048)
    monkeypatch.setattr(detector_module, "load_pixels", load)
    monkeypatch.setattr(detector_module, "select_from_maps", select)
    found = DeepDetect(backend="onnxruntime", resolution=resolution).detect("photo.jpg")
    assert len(found) > 100
    assert held == [False]
