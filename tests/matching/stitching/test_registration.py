from __future__ import annotations

import numpy as np
import pytest

from deepdetect import DeepDetect, DeepDetectError
from deepdetect.matching.stitching.registration import register_images
from deepdetect_lab.evaluation.metrics.homography import corner_error


@pytest.fixture(scope="module")
def detector() -> DeepDetect:
    return DeepDetect(threads=1)


@pytest.fixture(scope="module")
def strange() -> np.ndarray:
    data = pytest.importorskip("skimage.data")
    return np.ascontiguousarray(data.rocket()[:300, :300])


@pytest.mark.slow
def test_views_of_one_photograph(views, detector: DeepDetect) -> None:
    found = register_images(views.images, detector)
    assert sorted(found.homographies) == [0, 1, 2]
    assert found.unregistered == {}
    assert (0, 1) in found.matches
    assert (1, 2) in found.matches
    assert min(found.matches.values()) > 1000
    assert found.residual_px < 0.5
    frame = next(iter(found.homographies))
    assert frame == 1  # it has the most matches
    for number, matrix in found.homographies.items():
        true = views.homographies[frame] @ np.linalg.inv(views.homographies[number])
        assert corner_error(matrix, true, (300, 280)) < 0.5, number


@pytest.mark.slow
def test_the_larger_group_stays_and_the_others_are_told_why(
    views, detector: DeepDetect, strange: np.ndarray
) -> None:
    apart = [strange[:200, :200], strange[20:220, 40:240]]  # overlap, but only each other
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3)).astype(np.uint8)
    found = register_images([apart[0], *views.images, noise, apart[1]], detector)
    assert sorted(found.homographies) == [1, 2, 3]
    assert found.unregistered == {
        0: "it overlaps only with others that are not in the panorama",
        4: "it overlaps with no other image",
        5: "it overlaps only with others that are not in the panorama",
    }
    chosen = register_images([apart[0], *views.images, noise, apart[1]], detector, reference=5)
    assert sorted(chosen.homographies) == [0, 5]
    assert chosen.unregistered[1] == "it overlaps only with others that are not in the panorama"


def test_what_overlaps_with_nothing_is_refused(views, detector: DeepDetect, strange):
    with pytest.raises(DeepDetectError):
        register_images([views.images[0], strange], detector)
    with pytest.raises(DeepDetectError, match=r"images\[1\]"):
        register_images([views.images[0], strange, views.images[1]], detector, reference=1)
    flat = np.full((100, 120, 3), 90, np.uint8)
    with pytest.raises(DeepDetectError):
        register_images([flat, flat], detector)
