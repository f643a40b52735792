"""The packages of other programs, which need not be installed."""

from __future__ import annotations

import importlib
import importlib.util
from typing import TYPE_CHECKING, Any

from .._shared.errors import require_packages

if TYPE_CHECKING:

    class AnyBase:
        """What type checkers take for a base class that they do not know."""

        def __init__(self, *arguments: Any, **keywords: Any) -> None: ...

        def __getattr__(self, name: str) -> Any: ...


def _require(module: str) -> None:
    package = module.partition(".")[0]
    require_packages(f"the drop-in for {package}", package)


def import_package(module: str) -> Any:
    """Import a module of a package that need not be installed.

    Raises:
        MissingExtraError: the package is not installed.
    """
    _require(module)
    return importlib.import_module(module)


class _Missing(type):
    """The type of classes whose base is missing: all that one does with them raises an error."""

    module: str

    def __call__(cls, *args: object, **keywords: object) -> Any:
        _require(cls.module)

    def __getattr__(cls, name: str) -> Any:
        if not name.startswith("_"):  # Python looks for many of these
            _require(cls.module)
        raise AttributeError(name)


def base_class(module: str, name: str) -> type:
    """Return a class to derive from, as "Module" of "torch.nn", of a package that may be missing.

    What is derived from it then raises a MissingExtraError when it is used.

    Example:
        >>> base_class("no_such_package", "Model")()
        Traceback (most recent call last):
        ...
        deepdetect.MissingExtraError: the drop-in for no_such_package needs the package \
no_such_package, which is not installed: run pip install no_such_package
    """
    if importlib.util.find_spec(module.partition(".")[0]) is None:
        return _Missing(name, (), {"module": module})
    found: type = getattr(importlib.import_module(module), name)
    return found
