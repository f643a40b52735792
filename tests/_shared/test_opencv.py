from __future__ import annotations

import sys
from types import ModuleType

import pytest

from deepdetect._shared import opencv
from deepdetect._shared.errors import MissingExtraError


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV is looked for once: here, in each test."""
    opencv.import_opencv.cache_clear()
    yield
    monkeypatch.undo()
    opencv.import_opencv.cache_clear()


def put(monkeypatch: pytest.MonkeyPatch, **names: object) -> None:
    """Put another OpenCV into the place of the installed one."""
    other = ModuleType("cv2")
    vars(other).update(names)
    monkeypatch.setitem(sys.modules, "cv2", other)


@pytest.mark.parametrize("version", ["4.13.0", "4.14.0-pre", "5.0.0"])
def test_new_enough(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    put(monkeypatch, __version__=version, resize=7)
    assert opencv.cv2.resize == 7


def test_none_too_old_and_an_empty_folder_that_another_package_left(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError):
        assert opencv.cv2.resize
    put(monkeypatch, __version__="4.9.0")
    with pytest.raises(MissingExtraError, match=r"4\.9\.0"):
        assert opencv.cv2.resize
    put(monkeypatch)
    with pytest.raises(MissingExtraError):
        assert opencv.cv2.resize
