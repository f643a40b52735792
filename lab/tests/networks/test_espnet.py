from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from deepdetect import DeepDetect, WeightsError
from deepdetect_lab.evaluation.masks import load_sample, sample_images, score_samples
from deepdetect_lab.networks.espnet import ESPNet, ResidualPyramid
from deepdetect_lab.networks.export import export_onnx
from deepdetect_lab.networks.weights import load_network, save_tensors


def test_has_exactly_the_published_number_of_parameters() -> None:
    assert sum(parameter.numel() for parameter in ESPNet().parameters()) == 408_039


def test_state_dict_has_the_published_names_and_shapes(shared: Path) -> None:
    from safetensors.torch import load_file

    published = load_file(shared / "reference" / "published_matching.safetensors")
    ours = ESPNet().state_dict()
    assert len(published) == 258
    assert {n: t.shape for n, t in ours.items()} == {n: t.shape for n, t in published.items()}


def test_pyramid_branches_are_running_sums_of_the_dilated_convolutions() -> None:
    torch.manual_seed(0)
    block = ResidualPyramid(20, 20).eval()
    x = torch.rand(1, 20, 16, 16)
    with torch.inference_mode():
        reduced = block.c1(x)
        d = {k: getattr(block, f"d{k}")(reduced) for k in (1, 2, 4, 8, 16)}
        expected = [d[1], d[2], d[2] + d[4], d[2] + d[4] + d[8], d[2] + d[4] + d[8] + d[16]]
        torch.testing.assert_close(block.branches(x), torch.cat(expected, 1))
        torch.testing.assert_close(block(x), block.bn(x + torch.cat(expected, 1)))


@pytest.mark.slow
def test_published_weights_score_as_published(
    shared: Path, published: Callable[[str], Path]
) -> None:
    samples = sample_images(shared / "data" / "label-samples" / "val")
    scores = score_samples(DeepDetect(published("matching")).heatmap, map(load_sample, samples))
    # BCE and IoU of notes/published-system.md.
    assert scores["normal"].loss == pytest.approx(0.1028, abs=0.002)
    assert scores["normal"].iou == pytest.approx(0.854, abs=0.002)
    assert scores["low"].loss == pytest.approx(0.1443, abs=0.002)
    assert scores["low"].iou == pytest.approx(0.675, abs=0.002)
    assert (scores["normal"].images, scores["low"].images) == (5, 5)


def test_weights_survive_the_round_trip(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = ESPNet()
    save_tensors(network.state_dict(), tmp_path / "w.safetensors", {"note": "x"})
    loaded = load_network(tmp_path / "w.safetensors")
    for name, value in network.state_dict().items():
        assert torch.equal(value, loaded.state_dict()[name]), name
    assert not loaded.training


def test_a_pickle_is_refused_and_not_executed(tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    torch.save(ESPNet().state_dict(), path)
    with pytest.raises(WeightsError):
        load_network(path)


def test_onnx_gives_the_same_probabilities_at_any_size(tmp_path: Path) -> None:
    torch.manual_seed(1)
    network = ESPNet()
    # Running statistics other than the initial ones, so that folding them is tested.
    network.train()
    with torch.no_grad():
        network(torch.rand(2, 3, 64, 64))
    network.eval()
    export_onnx(network, tmp_path / "n.onnx")
    assert (tmp_path / "n.onnx").stat().st_size < 2_000_000
    import onnxruntime

    session = onnxruntime.InferenceSession(tmp_path / "n.onnx")
    for height, width in ((16, 16), (64, 96), (120, 40)):
        image = np.random.default_rng(height).random((1, 3, height, width), np.float32)
        with torch.inference_mode():
            expected = torch.sigmoid(network(torch.from_numpy(image))).numpy()
        np.testing.assert_allclose(session.run(None, {"image": image})[0], expected, atol=1e-5)
