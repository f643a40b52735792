from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.nn.functional import conv2d

from deepdetect._shared.errors import MissingWeightsError
from deepdetect_lab.training.teachers.aliked import (
    Aliked,
    DeformableConvolution,
    DescriptorHead,
    load_aliked,
)


def deformable(offset: tuple[float, float]) -> DeformableConvolution:
    """A convolution whose samples are all moved by an offset (y, x)."""
    torch.manual_seed(0)
    layer = DeformableConvolution(3, 4)
    torch.nn.init.zeros_(layer.offset_conv.weight)
    with torch.no_grad():
        assert layer.offset_conv.bias is not None
        layer.offset_conv.bias.copy_(torch.tensor(offset).repeat(9))
    return layer


@pytest.mark.parametrize("offset", [(0, 0), (1, 0), (0, -2)])
def test_moved_samples_are_those_of_a_moved_image(offset: tuple[int, int]) -> None:
    layer, image = deformable(offset), torch.rand(1, 3, 20, 24)
    moved = torch.roll(image, [-offset[0], -offset[1]], (2, 3))
    expected = conv2d(moved, layer.regular_conv.weight, padding=1)
    inside = (..., slice(4, -4), slice(4, -4))
    torch.testing.assert_close(layer(image)[inside], expected[inside], atol=1e-5, rtol=1e-4)


def test_a_descriptor_sums_the_samples_at_its_offsets() -> None:
    torch.manual_seed(1)
    head = DescriptorHead().eval()
    with torch.no_grad():
        head.agg_weights.copy_(torch.eye(128).expand(16, 128, 128) / 16)
        for layer in (head.offset_conv[0], head.offset_conv[2]):
            layer.weight.zero_()
            layer.bias.zero_()
        head.sf_conv.weight.copy_(torch.eye(128)[:, :, None, None])
        features = torch.rand(1, 128, 30, 40)
        found = head(features, torch.tensor([[12.0, 7.0], [39, 29], [0, 0]]))
    expected = torch.nn.functional.normalize(
        torch.selu(features[0, :, [7, 29, 0], [12, 39, 0]].T), dim=1
    )
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_padding_does_not_move_the_maps() -> None:
    torch.manual_seed(2)
    network, rgb = Aliked().eval(), torch.rand(1, 3, 70, 90)
    with torch.no_grad():
        features, scores = network.maps(rgb)
        padded = torch.nn.functional.pad(rgb, (3, 3, 13, 13), mode="replicate")
        expected = network.maps(padded)[0][..., 13:-13, 3:-3]
    assert features.shape == (1, 128, 70, 90)
    assert scores.shape == (1, 1, 70, 90)
    torch.testing.assert_close(features, expected)


def test_a_file_of_weights_is_loaded(tmp_path: Path) -> None:
    torch.manual_seed(3)
    network = Aliked().eval()
    torch.save(network.state_dict(), tmp_path / "weights.pth")
    rgb, xy = torch.rand(1, 3, 64, 64), torch.rand(20, 2) * 63
    codes, scores = load_aliked(tmp_path / "weights.pth")(rgb, xy)
    assert codes.shape == (20, 128)
    assert torch.equal(codes, network(rgb, xy)[0])
    highest = network.maps(rgb)[1][0, 0].max()
    assert scores.max() <= highest
    with pytest.raises(MissingWeightsError, match="Shiaoming/ALIKED"):
        load_aliked(tmp_path / "none.pth")
