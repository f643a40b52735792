from __future__ import annotations

import dataclasses
import importlib
import inspect
import math
import pkgutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import deepdetect
from deepdetect._shared.errors import OptionError
from deepdetect._shared.options import (
    check_ranges,
    look_up,
    names_a_file,
    suggest_keywords,
)

REGISTRY = {"default": 1, "dense": 2}


def test_a_decorated_function_suggests_the_right_keyword() -> None:
    @suggest_keywords
    def detect(image: str, *, max_keypoints: int | None = None) -> int | None:
        """Detect."""
        return max_keypoints

    assert detect("a.png", max_keypoints=5) == 5
    assert detect.__doc__ == "Detect."
    with pytest.raises(OptionError, match="'max_keypoints'"):
        detect("a.png", maxkeypoints=5)
    with pytest.raises(TypeError):
        detect()


@dataclass(frozen=True)
class Ranges:
    size_px: float = 1.0
    offsets_px: tuple[float, ...] = (1, 2)
    count: int = 0
    shares: tuple[tuple[float, float], ...] = ((0, 0.5), (1, 0.2))
    ratio: float = 1.5

    def __post_init__(self) -> None:
        check_ranges(
            self,
            positive=("size_px", "offsets_px"),
            not_negative=("count",),
            fractions=("shares",),
            between={"ratio": (1, math.inf), "count": (0, 9)},
        )


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("size_px", (0, math.nan, math.inf)),
        ("offsets_px", ((3, -1), ())),
        ("count", (-1, "3", 1.5, 10)),
        ("shares", (((0, 1.1),),)),
        ("ratio", (0.99,)),
    ],
)
def test_numbers_out_of_their_ranges_are_refused(name: str, values: tuple[Any, ...]) -> None:
    Ranges(size_px=np.float32(0.5), count=np.int64(9))
    for value in values:
        with pytest.raises(OptionError, match=f"`{name}`"):
            Ranges(**{name: value})


OPTIONS = sorted(
    {
        kind
        for module in pkgutil.walk_packages(deepdetect.__path__, "deepdetect.")
        if not module.name.startswith(
            ("deepdetect.cli", "deepdetect.__main__", "deepdetect.integrations")
        )
        for name, kind in vars(importlib.import_module(module.name)).items()
        if name.endswith("Options") and dataclasses.is_dataclass(kind)
    },
    key=lambda kind: kind.__name__,
)


@pytest.mark.parametrize("kind", OPTIONS, ids=lambda kind: kind.__name__)
def test_every_number_among_the_options_is_checked(kind: type) -> None:
    fields = dataclasses.fields(kind)
    numbers = [one.name for one in fields if type(one.default) in (int, float)]
    missing = dataclasses.MISSING
    needed = {f.name: None for f in fields if f.default is f.default_factory is missing}
    for name in numbers:
        with pytest.raises(OptionError, match=name):
            kind(**needed | {name: math.nan})


def public_callables() -> dict[str, Any]:
    """Functions, constructors and methods that a user calls with keywords."""
    found = {}
    for name in deepdetect.__all__:
        thing = getattr(deepdetect, name)
        if callable(thing) and not (isinstance(thing, type) and issubclass(thing, Exception)):
            found[name] = thing
    for kind in (deepdetect.DeepDetect, deepdetect.Keypoints, deepdetect.Matches):
        for name, method in vars(kind).items():
            method = getattr(method, "__func__", method)
            if name.startswith("_") or not inspect.isfunction(method):
                continue
            parameters = inspect.signature(method).parameters.values()
            passes_on = any(each.kind is each.VAR_KEYWORD for each in parameters)
            if len(parameters) > 1 and not passes_on:
                found[f"{kind.__name__}.{name}"] = method
    return found


@pytest.mark.parametrize("name", public_callables())
def test_an_unknown_keyword_of_anything_public_is_an_option_error(name: str) -> None:
    thing = public_callables()[name]
    if name == "DeepDetect":
        thing = thing.__init__
    known = [n for n in inspect.signature(thing).parameters if n not in ("self", "cls")]
    wrong = known[-1][:-1] + "_"  # one letter off
    with pytest.raises(OptionError, match=f"'{wrong}'.*'{known[-1]}'"):
        thing(**{wrong: None})


@pytest.mark.parametrize("kind", OPTIONS, ids=lambda kind: kind.__name__)
def test_an_unknown_field_of_any_options_is_an_option_error(kind: type) -> None:
    with pytest.raises(OptionError, match="'seeed'"):
        kind(seeed=1)


@pytest.mark.parametrize("value", ["mine.onnx", "./dense", "runs/dense", Path("a/b.onnx")])
def test_a_path_stays_a_path(value: str | Path) -> None:
    assert names_a_file(value)


def test_a_name_gives_its_entry_and_an_unknown_one_the_nearest() -> None:
    assert look_up("weights", "dense", REGISTRY) == 2
    with pytest.raises(OptionError, match="'dense'"):
        look_up("weights", "dens", REGISTRY)
