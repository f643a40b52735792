"""Adapt docstrings to griffe, which knows the section `Examples:`, while ours say `Example:`."""

from __future__ import annotations

import re
from typing import Any

from griffe import Extension, Object


class Examples(Extension):
    """Renames the section, so that its lines are shown as code."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        """Change a docstring before it is parsed."""
        if obj.docstring is not None:
            obj.docstring.value = plural(obj.docstring.value)


def plural(docstring: str) -> str:
    """Rename the sections `Example:` to `Examples:`."""
    return re.sub(r"^([ \t]*)Example:$", r"\1Examples:", docstring, flags=re.M)
