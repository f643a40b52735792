from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from deepdetect._shared.errors import ImageError, OptionError
from deepdetect._shared.image_array import array_to_rgb, check_channels


@pytest.mark.parametrize("count", [1, 3, 4])
def test_channels_may_come_first(count: int) -> None:
    last = np.random.default_rng(0).integers(0, 256, (20, 30, count), np.uint8)
    np.testing.assert_array_equal(array_to_rgb(np.moveaxis(last, 2, 0)), array_to_rgb(last))
    # 3x5 pixels with the channels last are no channels first.
    assert array_to_rgb(np.full((3, 5, count), 255, np.uint8)).shape == (3, 5, 3)


def test_bgr_is_what_opencv_calls_it(photo: np.ndarray) -> None:
    bgr = cv2.cvtColor(photo, cv2.COLOR_RGB2BGR)
    bgra = cv2.cvtColor(photo, cv2.COLOR_RGB2BGRA)
    for given in (bgr, bgra, bgr.transpose(2, 0, 1), bgra.transpose(2, 0, 1), bgr / 255):
        found = array_to_rgb(given, "bgr")
        np.testing.assert_array_equal(found, photo)
        assert found.flags.c_contiguous
    gray = photo[..., 0]
    np.testing.assert_array_equal(array_to_rgb(gray, "bgr"), array_to_rgb(gray))


def test_tensors_of_any_layout_and_type(photo: np.ndarray) -> None:
    torch = pytest.importorskip("torch", reason="needs torch for its tensors")
    whole = torch.tensor(photo)
    first = whole.permute(2, 0, 1)
    real = (first.float() / 255).requires_grad_()
    for tensor in (whole, first, real, real.double(), first[:1], whole[..., 0]):
        expected = photo if tensor.ndim == 3 and 3 in tensor.shape else photo[..., :1]
        np.testing.assert_array_equal(array_to_rgb(tensor), np.broadcast_to(expected, photo.shape))
    coarse = array_to_rgb(real.bfloat16()).astype(int)
    assert np.abs(coarse - photo).max() <= 1


@pytest.mark.parametrize("shape", [(1, 3, 20, 30), (5, 20, 30), (20, 30, 2), (20,)])
def test_what_is_no_image_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ImageError, match=re.escape(str(shape))):
        array_to_rgb(np.zeros(shape, np.uint8))
    with pytest.raises(OptionError, match="'rgb'"):
        check_channels("brg")
