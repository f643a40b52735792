"""Checks of options and names: an error for an unknown name suggests the nearest known one."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import math
import os
import reprlib
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any, Literal, ParamSpec, TypeVar

import numpy as np

from .errors import OptionError, check_name

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")
Entry = TypeVar("Entry")


def suggest_keywords(
    function: Callable[Parameters, Result], elsewhere: Mapping[str, str] = {}
) -> Callable[Parameters, Result]:
    """Decorate a function so that an unknown keyword raises an error that suggests a known one.

    An argument of a wrong type also raises an error if its annotation has only types in `ACCEPTED`
    and dataclasses. If `function` is a class, its `__init__` is decorated. `elsewhere` maps
    keywords of other functions to advice on what to do instead.
    """
    if isinstance(function, type):
        kind: Any = function
        kind.__init__ = suggest_keywords(kind.__init__)
        return function
    parameters = inspect.signature(function).parameters
    names = [name for name in parameters if name not in ("self", "cls")]

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        for name in kwargs:
            if name in elsewhere:
                raise OptionError(f"unknown option {name!r}: {elsewhere[name]}")
            check_name("option", name, names)
        kinds = _kinds(function)
        for name, value in (*zip(parameters, args, strict=False), *kwargs.items()):
            if name in kinds and not isinstance(value, kinds[name]):
                wanted = str(parameters[name].annotation)
                raise OptionError(f"`{name}` must be {wanted}, not {shown(value)}")
        return function(*args, **kwargs)

    return call


def shown(value: object) -> str:
    """Return a short text of a value, on one line, for an error message."""
    return " ".join(reprlib.repr(value).split())


ACCEPTED: Mapping[Any, tuple[Any, ...]] = {
    bool: (bool, np.bool_),
    int: (Real,),  # `check_ranges` checks that the numbers are whole
    float: (Real,),
    str: (str,),
    Path: (os.PathLike,),
    type(None): (type(None),),
    Callable: (Callable,),
    Mapping: (Mapping,),
}
"""Types of the values that an argument may have, by the type in its annotation."""
MADE_LATER = type(functools.cache(len))
"""Type of functions decorated with `functools.cache`. An argument may be such a function instead of
an object, for example keypoints; the function makes the object at the first use."""
KINDS_OF: Mapping[Any, Any] = {Literal: str, Callable: Callable, Mapping: Mapping}


@functools.cache
def _kinds(function: Callable[..., Any]) -> dict[str, tuple[Any, ...]]:
    """Return the accepted types of arguments annotated with `ACCEPTED` types or dataclasses."""
    try:
        hints = typing.get_type_hints(function)
    except NameError:  # a type that only type checkers import
        return {}
    found = {}
    for name, hint in hints.items():
        union = typing.get_origin(hint) in (typing.Union, types.UnionType)
        members = typing.get_args(hint) if union else (hint,)
        members = tuple(KINDS_OF.get(typing.get_origin(m), m) for m in members)
        if all(member in ACCEPTED or dataclasses.is_dataclass(member) for member in members):
            found[name] = tuple(k for m in members for k in ACCEPTED.get(m, (m, MADE_LATER)))
    return found


def numbers_of(name: str, value: Any, kind: type | None, columns: int | None = None) -> np.ndarray:
    """Return numbers as an array of the type `kind`; if `kind` is None, keep their own type.

    If `columns` is given, the array has two dimensions and this many columns. Raises an OptionError
    if the value is not numeric, or does not fill whole rows.
    """
    try:
        found: np.ndarray = np.asarray(value, kind)
        return found if columns is None else found.reshape(-1, columns)
    except (TypeError, ValueError, OverflowError):
        wanted = "numbers" if columns is None else f"rows of {columns} numbers"
        raise OptionError(f"`{name}` must be {wanted}, not {shown(value)}") from None


def whole(name: str, value: Any) -> int:
    """Return a number as an int, or raise an OptionError if it is negative or not whole."""
    number: Any = value if isinstance(value, Real) else -1
    if number < 0 or not float(number).is_integer():
        raise OptionError(f"`{name}` must be a whole number of at least 0, not {shown(value)}")
    return int(number)


LARGEST = 1e38
"""Options that `check_ranges` bounds only from below may not exceed this, to fit into float32."""


def check_ranges(
    options: object,
    *,
    positive: Sequence[str] = (),
    not_negative: Sequence[str] = (),
    fractions: Sequence[str] = (),
    counts: Sequence[str] = (),
    between: Mapping[str, tuple[float, float]] = {},
) -> None:
    """Check the numbers in the fields of `options`, including those in tuples; None always passes.

    Each argument names fields: those that must be above 0 (`positive`), at least 0
    (`not_negative`), in [0, 1] (`fractions`), whole numbers of at least 1 (`counts`), or between
    two limits (`between`). If the default of a field is an int, its value must be whole.

    Raises:
        OptionError: a value is not a number, or out of its range.
    """
    bounds = [(name, math.ulp(0), LARGEST, "be above 0") for name in positive]
    bounds += [(name, 0, LARGEST, "be 0 or more") for name in not_negative]
    bounds += [(name, 0, 1, "lie in [0, 1]") for name in fractions]
    bounds += [(name, 1, math.inf, "be a whole number of at least 1") for name in counts]
    for name, (smallest, largest) in between.items():
        limits = f"lie in [{smallest:.12g}, {largest:.12g}]"
        expected = f"be at least {smallest:.12g}" if largest == math.inf else limits
        bounds.append((name, smallest, largest, expected))
    for name, smallest, largest, expected in bounds:
        value = getattr(options, name)
        if value is None:
            continue
        values = _numbers(value)
        fits = bool(values) and all(smallest <= one <= largest for one in values)
        if name in counts or type(getattr(type(options), name, None)) is int:
            fits &= all(float(one).is_integer() for one in values)
        if not fits:
            raise OptionError(f"`{name}` must {expected}, not {value}")


def _numbers(value: object) -> list[Any]:
    if isinstance(value, tuple):
        return [number for one in value for number in _numbers(one)]
    return [value if isinstance(value, Real) else math.nan]


def look_up(kind: str, name: str, registry: Mapping[str, Entry]) -> Entry:
    """Return the entry of this name; `kind` says what the entries are, such as "matcher".

    Raises an OptionError if the name is unknown.
    """
    check_name(kind, name, registry)
    return registry[name]


def names_a_file(value: str | Path) -> bool:
    """Return whether a value is a path rather than a name: it has a suffix or a separator."""
    text = str(value)
    return bool(Path(text).suffix) or any(mark in text for mark in (os.sep, os.altsep) if mark)
