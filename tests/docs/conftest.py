"""The modules of docs/hooks, which mkdocs runs and which are no package."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def hooks() -> ModuleType:
    """The module docs/hooks/site.py."""
    sys.path.insert(0, str(ROOT / "docs/hooks"))
    try:
        # Not by its name, which is one of the standard library's.
        spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs/hooks/site.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    finally:
        sys.path.remove(str(ROOT / "docs/hooks"))
    return module
