from __future__ import annotations

from types import SimpleNamespace

import pytest

from deepdetect._shared.errors import MissingExtraError
from deepdetect_lab.labels import detectors


@pytest.mark.parametrize("home", ["main", "xfeatures2d"])
def test_factories_of_both_places(monkeypatch: pytest.MonkeyPatch, home: str) -> None:
    other = SimpleNamespace(__version__="5.0.0", xfeatures2d=SimpleNamespace())
    place = other if home == "main" else other.xfeatures2d
    place.BRISK_create = len
    monkeypatch.setattr(detectors, "cv2", other)
    assert detectors.opencv_factory("BRISK_create") is len


def test_factories_of_contrib_modules_that_are_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detectors, "cv2", SimpleNamespace(__version__="5.0.0"))
    monkeypatch.setattr(detectors, "installed_distributions", lambda: ["opencv-python"])
    with pytest.raises(MissingExtraError, match="AGAST"):
        detectors.opencv_factory("AgastFeatureDetector_create")
