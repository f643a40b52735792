"""Images as OpenCV has them give what their files give, everywhere an image is taken."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

import deepdetect
import deepdetect_lab.labels
from deepdetect import OptionError
from deepdetect_lab.evaluation.baselines.random import RandomDetector

EVERY = deepdetect.SelectionOptions(density=1)


def views(photo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two colourful views, whose luma depends on the order of the colours."""
    return photo[:160, 40:200], photo[:160, 64:224]


def as_opencv(images: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    return [cv2.cvtColor(image, cv2.COLOR_RGB2BGR) for image in images]


def calls() -> dict[str, Any]:
    def calibrated(left: Any, right: Any, **options: Any) -> np.ndarray:
        found = deepdetect.reconstruct(
            left, right, RandomDetector(), focal_px=300, rectified=True, selection=EVERY, **options
        )
        return np.column_stack([found.points, found.colors])

    return {
        "load_image": lambda a, b, **o: deepdetect.load_image(a, **o),
        "register": lambda a, b, **o: deepdetect.register(a, b, RandomDetector(), **o).warped,
        "stitch": lambda a, b, **o: deepdetect.stitch([a, b], detector=RandomDetector(), **o).image,
        "reconstruct": calibrated,
        "disparity_map": lambda a, b, **o: deepdetect.disparity_map(a, b, **o).disparity,
        "fuse": lambda a, b, **o: deepdetect_lab.labels.fuse(a, **o).mask,
        "points": lambda a, b, **o: deepdetect.PointDetector(50).detect(a, **o).xy,
    }


@pytest.mark.parametrize("name", calls())
def test_bgr_gives_what_rgb_gives(name: str, photo: np.ndarray, facade: Any) -> None:
    images = views(photo)
    if name in ("reconstruct", "disparity_map"):  # they want depth
        rng = np.random.default_rng(0)
        scene = cv2.GaussianBlur(rng.integers(0, 256, (96, 200, 3)).astype(np.uint8), (0, 0), 1)
        x, y = np.meshgrid(np.arange(160, dtype=np.float32), np.arange(96, dtype=np.float32))
        shifts = (10 + y / 16, 20 + y / 8)
        images = tuple(cv2.remap(scene, x + shift, y, cv2.INTER_CUBIC) for shift in shifts)
    call = calls()[name]
    expected = call(*images)
    np.testing.assert_array_equal(call(*as_opencv(images), channels="bgr"), expected)
    planes = [np.ascontiguousarray(bgr.transpose(2, 0, 1)) for bgr in as_opencv(images)]
    np.testing.assert_array_equal(call(*planes, channels="bgr"), expected)
    # The test sees a difference where there is one.
    assert not np.array_equal(call(*as_opencv(images)), expected, equal_nan=True)
    with pytest.raises(OptionError, match="'brg'"):
        call(*images, channels="brg")


def test_files_say_their_order_themselves(photo: np.ndarray, photo_path: Any) -> None:
    np.testing.assert_array_equal(deepdetect.load_image(photo_path, channels="bgr"), photo)
    np.testing.assert_array_equal(
        deepdetect.load_image(photo_path.read_bytes(), channels="bgr"), photo
    )


def test_luma_is_taken_as_it_is(photo: np.ndarray) -> None:
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    fuse = deepdetect_lab.labels.fuse
    np.testing.assert_array_equal(fuse(gray).mask, fuse(photo).mask)
    assert fuse(gray[:10, :12]).mask.shape == (10, 12)


def test_the_order_for_the_network_is_another_matter(photo: np.ndarray) -> None:
    with pytest.raises(OptionError, match="'bgr'"):
        deepdetect.DeepDetect(channels="bgr")  # type: ignore[call-arg]
    bgr = photo[..., ::-1]
    swapped = deepdetect.DeepDetect(network_channels="bgr", resolution=64)
    plain = deepdetect.DeepDetect(resolution=64)
    np.testing.assert_array_equal(swapped.heatmap(photo), plain.heatmap(bgr))
    np.testing.assert_array_equal(swapped.heatmap(bgr, channels="bgr"), plain.heatmap(bgr))
