"""With vismatch where it is installed, else with a base class of the same contract."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")

STAND_IN = """
import cv2
import torch

class BaseMatcher(torch.nn.Module):
    def __init__(self, device="cpu", **kwargs):
        super().__init__()
        self.device = device
        self.ransac_reproj_thresh = kwargs.get("ransac_reproj_thresh", 3)

    @torch.inference_mode()
    def forward(self, img0, img1):
        outputs = self._forward(img0.to(self.device), img1.to(self.device))
        assert len(outputs) == 7
        matched0, matched1, all0, all1, descriptors0, descriptors1, confidences = outputs
        found = {"H": None, "num_inliers": 0}
        if len(matched0) >= 4:
            found["H"], inliers = cv2.findHomography(
                matched0, matched1, cv2.USAC_MAGSAC, self.ransac_reproj_thresh
            )
            found["num_inliers"] = int(inliers.sum())
        return {
            "matched_kpts0": matched0,
            "matched_kpts1": matched1,
            "all_kpts0": all0,
            "all_kpts1": all1,
            "matched_confidences": confidences,
            **found,
        }
"""


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1).float() / 255


@pytest.mark.parametrize(("count", "least"), [(500, 200), (None, 3000)])
def test_matches_of_two_views(
    views: Views, drop_in: Callable[..., ModuleType], count: int | None, least: int
) -> None:
    vismatch = drop_in("vismatch", {"vismatch/__init__.py": STAND_IN})
    matcher = vismatch.DeepDetectMatcher(max_num_keypoints=count, ransac_reproj_thresh=2)
    assert matcher.ransac_reproj_thresh == 2
    found = matcher(tensor(views.first), tensor(views.second))
    points0, points1 = found["matched_kpts0"], found["matched_kpts1"]
    assert len(points0) == len(found["matched_confidences"]) > least
    assert views.correct(points0, points1) > 0.95
    assert found["num_inliers"] > 0.9 * len(points0)
    homography = found["H"] / found["H"][2, 2]
    assert homography[:2, :2] == pytest.approx(views.affinity[:, :2], abs=0.03)
    assert found["all_kpts0"].shape[1] == 2
    assert count is None or len(found["all_kpts0"]) == count


def test_no_matches_are_an_empty_answer(drop_in: Callable[..., ModuleType]) -> None:
    vismatch = drop_in("vismatch", {"vismatch/__init__.py": STAND_IN})
    flat = torch.full((3, 64, 80), 0.4)
    found = vismatch.DeepDetectMatcher()(flat, flat)
    assert found["matched_kpts0"].shape == (0, 2)
    assert found["H"] is None
