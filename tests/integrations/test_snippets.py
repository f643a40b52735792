"""The snippets of docs/other-programs.md run, each where its program is installed."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from .conftest import Views

PAGE = Path(__file__).parents[2] / "docs/other-programs.md"
SECTIONS = dict(re.findall(r"^### (\S+)\n(.*?)(?=^##|\Z)", PAGE.read_text("utf-8"), re.S | re.M))
SNIPPETS = {
    name: "\n".join(re.findall(r"^```python\n(.*?)^```", text, re.S | re.M))
    for name, text in SECTIONS.items()
    if "```python" in text
}


def stored_matches(found: dict[str, Any]) -> int:
    import h5py

    with h5py.File(found["matches"]) as file:
        return int((file["left.png/right.png/matches0"][:] >= 0).sum())


COUNTS: dict[str, Callable[[dict[str, Any]], int]] = {
    "OpenCV": lambda found: len(found["matches"]),
    "kornia": lambda found: len(found["matches"]["keypoints0"]),
    "LightGlue": lambda found: found["matches"]["matches0"].shape[1],  # their weights are random
    "hloc": stored_matches,
    "scikit-image": lambda found: len(found["points"]),
    "transformers": lambda found: int(found["outputs"].mask.sum()),
}


def test_every_program_has_a_snippet() -> None:
    assert set(SNIPPETS) == set(COUNTS)


@pytest.mark.parametrize("name", COUNTS)
@pytest.mark.filterwarnings("ignore")  # of the programs
def test_the_snippet_runs(
    name: str,
    views: Views,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    snippet = SNIPPETS[name]
    needed = set(re.findall(r"^(?:from|import) (\w+)", snippet, re.M)) - {"deepdetect"}
    for package in needed:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"needs {package}")
    (tmp_path / "images").mkdir()
    for side, view in (("left", views.first), ("right", views.second)):
        Image.fromarray(view).save(tmp_path / f"{side}.png")
        Image.fromarray(view).save(tmp_path / f"images/{side}.png")
    (tmp_path / "pairs.txt").write_text("left.png right.png\n")
    if "dist/hub" in snippet:
        (tmp_path / "dist").mkdir()
        (tmp_path / "dist/hub").symlink_to(request.getfixturevalue("hub"))
    monkeypatch.chdir(tmp_path)
    found: dict[str, Any] = {}
    exec(compile(snippet, f"{PAGE.name}: {name}", "exec"), found)
    assert COUNTS[name](found) > 150
