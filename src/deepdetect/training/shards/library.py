"""The library that shards need."""

from __future__ import annotations

from typing import Any

from ..._shared.errors import MissingExtraError


def webdataset() -> Any:
    """Import WebDataset.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import webdataset as library
    except ImportError:
        raise MissingExtraError(
            "shards need the package webdataset, which is not installed: run pip install webdataset"
        ) from None
    return library
