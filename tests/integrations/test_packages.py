from __future__ import annotations

import importlib
import sys

import pytest

from deepdetect import MissingExtraError

NEEDED = {
    "hloc": "hloc",
    "kornia": "kornia",
    "lightglue": "torch",
}


@pytest.mark.parametrize("name", NEEDED)
def test_without_its_program_a_drop_in_says_what_to_install(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in (*NEEDED, "torch"):
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"deepdetect.integrations.{name}", raising=False)
    with pytest.raises(MissingExtraError, match=NEEDED[name]):
        importlib.import_module(f"deepdetect.integrations.{name}")


def test_opencv_needs_nothing_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "deepdetect.integrations.opencv", raising=False)
    importlib.import_module("deepdetect.integrations.opencv").DeepDetectFeature2D()
