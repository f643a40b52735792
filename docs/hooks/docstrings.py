"""Docstrings as griffe reads them: it knows a section `Examples:`, and ours say `Example:`."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object


class Examples(Extension):
    """Names the section as griffe does, so that its lines are shown as code."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Change a docstring before it is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = plural(obj.docstring.value)


def plural(docstring: str) -> str:
    """Name the section of examples in the plural."""
    return re.sub(r"^([ \t]*)Example:$", r"\1Examples:", docstring, flags=re.M)
