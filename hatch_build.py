"""The README as package indexes show it: its links and pictures lead to the repository.

On an index there is nothing beside the README. So links to files become links to the repository at
the tag of the version, which is made before the package is published.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

REPOSITORY = "deepdetect/deepdetect"
PICTURES = (".gif", ".jpg", ".png", ".svg", ".webp")


class ReadmeHook(MetadataHookInterface):
    """Puts the README into the metadata of the package."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the field `readme`."""
        root = Path(self.root)
        source = (root / "src/deepdetect/__init__.py").read_text("utf-8")
        version = re.search(r'^__version__ = "(.+)"$', source, re.M)
        if version is None:
            raise ValueError("src/deepdetect/__init__.py names no __version__")
        text = absolute_links((root / "README.md").read_text("utf-8"), f"v{version[1]}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def absolute_links(markdown: str, tag: str, folder: str = "") -> str:
    """Return a page of a folder with links to the repository at a tag in place of relative ones.

    Example:
        >>> absolute_links("[how](docs/a.md#b), ![](c.png), [below](#d)", "v1.0")[:59]
        '[how](https://github.com/deepdetect/deepdetect/blob/v1.0/do'
    """

    def absolute(match: re.Match[str]) -> str:
        target = match[1]
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        target = posixpath.normpath(posixpath.join(folder, target))
        if target.partition("#")[0].endswith(PICTURES):
            return f"](https://raw.githubusercontent.com/{REPOSITORY}/{tag}/{target})"
        return f"](https://github.com/{REPOSITORY}/blob/{tag}/{target})"

    return re.sub(r"\]\(([^)\s]+)\)", absolute, markdown)
