"""The README that package indexes show."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_links_of_the_readme_work_on_an_index() -> None:
    pytest.importorskip("hatchling", reason="needs hatchling, which builds the wheel")
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    hook = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hook)
    readme = (ROOT / "README.md").read_text("utf-8")
    text = hook.absolute_links(readme, "v1.2.3")
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    own = "deepdetect/deepdetect"
    assert len(targets) > 10
    assert len(targets) == len(re.findall(r"\]\(([^)\s]+)\)", readme))
    for target in targets:
        assert target.startswith(("https://", "#"))
        page = re.fullmatch(rf"https://github\.com/{own}/blob/v1\.2\.3/([^#]+)(#.*)?", target)
        picture = re.fullmatch(rf"https://raw\.githubusercontent\.com/{own}/v1\.2\.3/(.+)", target)
        if page or picture:
            assert (ROOT / (page or picture)[1]).exists(), target
    assert "raw.githubusercontent.com" in text
