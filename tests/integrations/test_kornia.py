from __future__ import annotations

import cv2
import numpy as np
import pytest

from deepdetect import OptionError, PointDetector
from deepdetect.io.image import luma

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")
kornia_feature = pytest.importorskip("kornia.feature", reason="needs kornia")
kornia = pytest.importorskip("deepdetect.integrations.kornia")


def tensor(*images: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2).float() / 255


def test_frames_are_those_of_the_detector(views: Views) -> None:
    expected = PointDetector(100).detect(views.first)
    lafs, scores = kornia.DeepDetectDetector(PointDetector(100))(tensor(views.first))
    assert lafs.shape == (1, 100, 2, 3)
    assert np.array_equal(kornia_feature.get_laf_center(lafs)[0], expected.xy)
    assert np.array_equal(scores[0], expected.scores)


def test_patches_are_what_sift_describes(views: Views) -> None:
    """A SIFT descriptor covers a square of six times the size, its x axis along the angle."""
    points = PointDetector(200).detect(views.first)
    inside = np.abs(points.xy - (127.5, 99.5)) < (127.5, 99.5) - 4.3 * points.sizes[:, None]
    rows = np.flatnonzero(inside.all(axis=1))
    assert len(rows) > 30
    gray = luma(views.first)
    image = tensor(views.first).mean(1, keepdim=True)
    lafs = kornia.DeepDetectDetector(PointDetector(200))(tensor(views.first))[0][:, rows]
    patches = kornia_feature.extract_patches_from_pyramid(image, lafs, 16)[0, :, 0].numpy()
    for row, patch in zip(rows, patches, strict=True):
        (x, y), size, angle = points.xy[row], points.sizes[row], np.deg2rad(points.angles[row])
        axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        step = 6 * size / 16
        to_image = np.column_stack([step * axes, (x, y) - step * axes @ (7.5, 7.5)])
        smooth = cv2.GaussianBlur(gray, (0, 0), 0.4 * step)
        expected = cv2.warpAffine(
            smooth, to_image, (16, 16), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        )
        assert np.corrcoef(patch.ravel(), expected.ravel())[0, 1] > 0.9, row


@pytest.mark.parametrize("descriptor", ["ours", "kornia"])
def test_matches_of_two_views(views: Views, descriptor: str) -> None:
    local_feature = kornia.DeepDetectFeature(PointDetector(500))
    if descriptor == "kornia":
        patches = kornia_feature.LAFDescriptor(kornia_feature.SIFTDescriptor(32, rootsift=True))
        local_feature = kornia_feature.LocalFeature(
            kornia.DeepDetectDetector(PointDetector(500)), patches
        )
    matcher = kornia_feature.LocalFeatureMatcher(
        local_feature, kornia_feature.DescriptorMatcher("smnn", 0.9)
    )
    found = matcher({"image0": tensor(views.first), "image1": tensor(views.second)})
    points0, points1 = found["keypoints0"].numpy(), found["keypoints1"].numpy()
    assert len(points0) > 100
    assert views.correct(points0, points1) > 0.85


def test_a_batch_is_filled_as_kornia_does(views: Views) -> None:
    flat = np.full_like(views.first, 90)
    lafs, scores, descriptors = kornia.DeepDetectFeature(PointDetector(50))(
        tensor(views.first, flat)
    )
    assert (lafs.shape[:2], scores.shape, descriptors.shape) == ((2, 50), (2, 50), (2, 50, 64))
    assert kornia_feature.laf_is_filled(lafs).sum(dim=1).tolist() == [50, 0]
    assert torch.allclose(descriptors[0].norm(dim=1), torch.ones(50))
    alone = kornia.DeepDetectFeature(PointDetector(50))(tensor(flat))
    assert [len(part[0]) for part in alone] == [0, 0, 0]


def test_a_mask_hides(views: Views) -> None:
    mask = torch.zeros(1, 1, 200, 256)
    mask[:, :, :, :100] = 1
    lafs, _ = kornia.DeepDetectDetector(PointDetector(50))(tensor(views.first), mask)
    assert kornia_feature.get_laf_center(lafs)[..., 0].max() < 101
    with pytest.raises(OptionError):
        kornia.DeepDetectDetector(PointDetector(50))(tensor(views.first), mask[0])
