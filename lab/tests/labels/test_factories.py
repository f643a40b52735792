from __future__ import annotations

from types import ModuleType

import pytest

from deepdetect._shared.errors import MissingExtraError
from deepdetect_lab.labels import factories


@pytest.mark.parametrize("home", ["main", "xfeatures2d"])
def test_factories_of_both_places(monkeypatch: pytest.MonkeyPatch, home: str) -> None:
    contrib = ModuleType("xfeatures2d")
    main = ModuleType("cv2")
    main.xfeatures2d, place = contrib, main if home == "main" else contrib
    place.BRISK_create = len
    monkeypatch.setattr(factories, "cv2", main)
    assert factories.opencv_factory("BRISK_create") is len


def test_factories_of_contrib_modules_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    main = ModuleType("cv2")
    main.__version__ = "5.0.0"
    monkeypatch.setattr(factories, "cv2", main)
    monkeypatch.setattr(factories, "installed_distributions", lambda: ["opencv-python"])
    with pytest.raises(MissingExtraError, match="AGAST"):
        factories.opencv_factory("AgastFeatureDetector_create")
