"""Options as frozen dataclasses, in which an unknown name is an error that names the right one."""

from __future__ import annotations

import dataclasses
from typing import Any, TypeVar

from .errors import unknown_name

Options = TypeVar("Options")


def changed(options: Options, **changes: Any) -> Options:
    """Return options with some values changed, also those of options inside them.

    Args:
        options: a frozen dataclass, some of whose fields may be such dataclasses.
        changes: new values by field name.

    Raises:
        OptionError: a name is unknown (the nearest right one is named), or a dataclass
            refuses a value.

    Example:
        >>> from deepdetect.geometry import GeometryOptions
        >>> changed(GeometryOptions(), estimator="ransac").estimator
        'ransac'
        >>> changed(GeometryOptions(), estimater="ransac")
        Traceback (most recent call last):
        ...
        deepdetect.errors.OptionError: unknown option 'estimater': did you mean 'estimator'? \
(known: model, estimator, inlier_threshold, homography, camera0, camera1, confidence, iterations, \
seed)
    """
    homes = _homes(options)
    for name in changes:
        if name not in homes:
            raise unknown_name("option", name, homes)
    return _rebuild(options, changes)


def option_names(options: Any) -> list[str]:
    """List the names that `changed` takes for these options."""
    return list(_homes(options))


def _homes(options: Any) -> dict[str, Any]:
    """Map each name to the dataclass that holds it, the outermost where several do."""
    own: dict[str, Any] = {}
    inner: dict[str, Any] = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            inner |= _homes(value)
        own[field.name] = options
    return own | {name: home for name, home in inner.items() if name not in own}


def _rebuild(options: Any, changes: dict[str, Any]) -> Any:
    values = {}
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name in changes:
            values[field.name] = changes[field.name]
        elif dataclasses.is_dataclass(value):
            values[field.name] = _rebuild(value, changes)
    return dataclasses.replace(options, **values)
