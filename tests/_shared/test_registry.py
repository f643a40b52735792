from __future__ import annotations

from pathlib import Path

import pytest

from deepdetect._shared.errors import OptionError
from deepdetect._shared.registry import is_path, look_up, resolve_name_or_path

REGISTRY = {"default": 1, "dense": 2}


def test_a_name_gives_its_entry() -> None:
    assert look_up("weights", "dense", REGISTRY) == 2
    assert resolve_name_or_path("weights", "dense", REGISTRY) == 2


@pytest.mark.parametrize("value", ["mine.onnx", "./dense", "runs/dense", Path("a/b.onnx")])
def test_a_path_stays_a_path(value: str | Path) -> None:
    assert is_path(value)
    assert resolve_name_or_path("weights", value, REGISTRY) == Path(value)


@pytest.mark.parametrize("find", [look_up, resolve_name_or_path])
def test_an_unknown_name_suggests_the_nearest(find) -> None:
    with pytest.raises(OptionError, match="unknown weights 'dens': did you mean 'dense'"):
        find("weights", "dens", REGISTRY)
