from __future__ import annotations

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from deepdetect import DeepDetect
from deepdetect.io.image import luma
from deepdetect_lab.networks.fast import Exposure, FastNetwork, Luma
from deepdetect_lab.networks.weights import load_network


def planes_of(rgb: np.ndarray) -> torch.Tensor:
    """Return (1, 3, H, W) in [0, 1] of (H, W, 3) uint8."""
    return torch.from_numpy(rgb.transpose(2, 0, 1)[None] * np.float32(1 / 255))


def test_has_the_parameters_and_the_cost_it_tells() -> None:
    network = FastNetwork().eval()
    assert sum(parameter.numel() for parameter in network.parameters()) == 57_613
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network(torch.zeros(1, 3, 240, 320))
    assert counter.get_total_flops() / 2 * 4 == pytest.approx(632e6, rel=1e-3)


def test_the_luma_is_opencv_s_for_every_colour() -> None:
    values = np.arange(256, dtype=np.uint8)
    for red in range(256):
        rgb = np.empty((256, 256, 3), np.uint8)
        rgb[:] = np.dstack([np.full((256, 256), red), *np.meshgrid(values, values)])
        expected = torch.from_numpy(luma(rgb))[None, None] / 255
        assert torch.equal(Luma()(planes_of(rgb)), expected)


def test_the_exposure_is_that_of_every_eighth_pixel() -> None:
    image = torch.rand(2, 1, 45, 70)
    features, mean = Exposure()(image)
    counted = image[:, 0, ::8, ::8].flatten(1).double()
    np.testing.assert_allclose(mean.flatten(), counted.mean(1), atol=1e-6)
    np.testing.assert_allclose(features[:, 24].flatten(), counted.mean(1), atol=1e-6)
    variance = torch.log(counted.var(1, correction=0) + 1e-6) / 4
    np.testing.assert_allclose(features[:, 25].flatten(), variance, atol=1e-5)
    # Every value counts once, divided between the two bins beside it.
    shares = (torch.exp(features[:, :24, 0, 0].double() / 0.3) - 1e-3) / 24
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-4)
    np.testing.assert_allclose(
        shares @ torch.arange(24.0).double() / 23, counted.mean(1), atol=1e-4
    )


def test_the_global_term_sees_the_whole_image(fast_network: FastNetwork) -> None:
    """A part that no convolution sees changes the logits, as it changes labels."""
    image = torch.rand(1, 3, 64, 512) / 4
    changed = image.clone()
    changed[..., 384:] *= 4
    with torch.inference_mode():
        before, after = fast_network(image), fast_network(changed)
    assert (before - after)[..., :256].abs().mean() > 1e-3
    # What the convolutions see is less than the 32 px by which tiles overlap.
    fast_network = copy.deepcopy(fast_network)
    fast_network.thresholds[2].weight.data.zero_()
    fast_network.gain[2].weight.data.zero_()
    changed = image.clone()
    changed[0, 1, 1::8, 257::8] = 1 - changed[0, 1, 1::8, 257::8]  # not counted: the mean stays
    with torch.inference_mode():
        difference = (fast_network(image) - fast_network(changed)).abs()
    assert difference[..., : 256 - 32].max() < 1e-6
    assert difference[..., 256 - 16 : 256].max() > 1e-6


@pytest.mark.parametrize("size", [(16, 16), (64, 96), (123, 157), (80, 41)])
@pytest.mark.parametrize("backend", ["onnxruntime", "openvino"])
def test_onnx_gives_the_same_logits_at_any_size(
    backend: str, size: tuple[int, int], fast_files: tuple[Path, Path], photo: np.ndarray
) -> None:
    rgb = photo[: size[0], : size[1]]
    _, found = DeepDetect(fast_files[0], backend=backend, threads=1).heatmap_and_logits(rgb)
    padding = ((0, -size[0] % 8), (0, -size[1] % 8), (0, 0))
    padded = np.pad(rgb, padding, mode="edge").transpose(2, 0, 1)[None] / np.float32(255)
    with torch.inference_mode():
        whole = load_network(fast_files[1])(torch.from_numpy(padded))[0, 0].numpy()
    expected = whole[: size[0], : size[1]]
    assert expected.std() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_an_exported_file_is_small_and_gives_logits(
    fast_files: tuple[Path, Path], photo: np.ndarray
) -> None:
    import onnxruntime

    assert fast_files[0].stat().st_size < 300_000
    session = onnxruntime.InferenceSession(fast_files[0])
    (logits,) = session.run(["logits"], {"image": planes_of(photo).numpy()})
    _, expected = DeepDetect(fast_files[0], backend="onnxruntime").heatmap_and_logits(photo)
    np.testing.assert_allclose(logits[0, 0], expected, atol=1e-4)


def test_autocast_does_not_round_the_luma(fast_network: FastNetwork) -> None:
    """An image of two neighbouring grey levels, which bfloat16 would round to one."""
    levels = torch.full((1, 3, 64, 64), 201 / 255)
    levels[..., ::2, ::3] = 202 / 255
    with torch.inference_mode():
        expected = fast_network(levels)
        with torch.autocast("cpu", torch.bfloat16):
            found = fast_network(levels)
    assert (expected - found).abs().mean() < 0.1 * expected.std()
