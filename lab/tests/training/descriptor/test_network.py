from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch.nn.functional import avg_pool2d

from deepdetect._shared.errors import WeightsError
from deepdetect_lab.training.descriptor import network as module
from deepdetect_lab.training.descriptor.network import DescriptorNetwork

from .conftest import Published


def test_it_starts_with_the_published_layers(published: Published, l64: Path) -> None:
    network = DescriptorNetwork().eval()
    network.start_from(l64)
    luma = torch.rand(1, 1, 128, 256)
    with torch.no_grad():
        quarter, eighth, coarsest = published(luma)
        found = network.maps(luma)
        torch.testing.assert_close(found[0][0], quarter, atol=1e-5, rtol=1e-4)
        own = network.block_eighth(avg_pool2d(quarter, 2))
        torch.testing.assert_close(own, eighth, atol=1e-5, rtol=1e-4)
        own = network.block_coarsest(avg_pool2d(eighth, 4))
        torch.testing.assert_close(own, coarsest, atol=1e-5, rtol=1e-4)
    shapes = [[tuple(each.shape[1:]) for each in octave] for octave in found]
    assert shapes == [[(16, 32 >> k, 64 >> k), (64, 16 >> k, 32 >> k)] for k in range(3)]
    folded = [name for name, _ in network.named_parameters() if name.startswith(module.BACKBONE)]
    known = [f"{name}.{part}" for name in module.PUBLISHED for part in ("weight", "bias")]
    assert sorted(folded) == sorted(known)


def test_other_files_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.pth"
    for content in ({"block1.0.layer.0.weight": torch.ones(8, 1, 4, 4)}, None):
        torch.save(content, other) if content else other.write_bytes(b"nothing")
        with pytest.raises(WeightsError, match="does not hold"):
            DescriptorNetwork().start_from(other)
    with pytest.raises(WeightsError, match="L64"):
        DescriptorNetwork().start_from(tmp_path / "none.pth")


@pytest.mark.parametrize("size", [3.0, 40.0])
def test_what_is_far_away_counts(size: float) -> None:
    torch.manual_seed(0)
    network = DescriptorNetwork().eval()
    luma, xy = torch.rand(1, 1, 256, 256, requires_grad=True), torch.full((1, 1, 2), 128.0)
    network(luma, xy, torch.full((1, 1), size))[0, 0, 0].backward()
    assert luma.grad is not None
    near = luma.grad[0, 0, 120:136, 120:136].abs().mean()
    far = luma.grad[0, 0, 80:96, 80:96].abs().mean()
    assert near > far > 0
