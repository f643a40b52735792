"""The file for vismatch, with vismatch or a base class of the same contract."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest

from .conftest import Views

torch = pytest.importorskip("torch", reason="needs torch")

FILE = Path(__file__).parents[2] / "examples/vismatch/deepdetect.py"


class StandIn(torch.nn.Module):
    def __init__(self, device: str = "cpu", ransac_reproj_thresh: float = 3) -> None:
        super().__init__()
        self.threshold = ransac_reproj_thresh

    @torch.inference_mode()
    def forward(self, img0: torch.Tensor, img1: torch.Tensor) -> dict[str, Any]:
        names = ("matched_kpts0", "matched_kpts1", "all_kpts0", "all_kpts1")
        *points, _, _, confidences = self._forward(img0, img1)
        found = {**dict(zip(names, points, strict=True)), "matched_confidences": confidences}
        if len(points[0]) < 4:
            return {**found, "H": None, "num_inliers": 0}
        homography, inliers = cv2.findHomography(*points[:2], cv2.USAC_MAGSAC, self.threshold)
        return {**found, "H": homography, "num_inliers": int(inliers.sum())}


@pytest.fixture
def matcher(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the matcher."""
    if importlib.util.find_spec("vismatch") is None:
        stand_in = ModuleType("vismatch")
        stand_in.BaseMatcher = StandIn  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, "vismatch", stand_in)
    spec = importlib.util.spec_from_file_location("vismatch_deepdetect", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.DeepDetectMatcher


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.copy()).permute(2, 0, 1).float() / 255


@pytest.mark.parametrize(("count", "least"), [(500, 200), (None, 3000)])
def test_matches_of_two_views(views: Views, matcher: Any, count: int | None, least: int) -> None:
    images = tensor(views.first), 1.01 * tensor(views.second)  # bicubic filters overshoot
    found = matcher(max_num_keypoints=count, ransac_reproj_thresh=2)(*images)
    points0, points1 = found["matched_kpts0"], found["matched_kpts1"]
    assert len(points0) == len(found["matched_confidences"]) > least
    assert views.correct(points0, points1) > 0.95
    assert found["num_inliers"] > 0.9 * len(points0)
    homography = found["H"] / found["H"][2, 2]
    assert homography[:2, :2] == pytest.approx(views.affinity[:, :2], abs=0.03)
    assert found["all_kpts0"].shape[1] == 2
    assert count is None or len(found["all_kpts0"]) == count


def test_no_matches_are_an_empty_answer(matcher: Any) -> None:
    flat = torch.full((3, 64, 80), 0.4)
    found = matcher()(flat, flat)
    assert found["matched_kpts0"].shape == (0, 2)
    assert found["H"] is None
