"""The site is built strictly, without the network, and its pages ask for nothing elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytest.importorskip("mkdocs", reason="needs mkdocs: `make test-docs`")

ROOT = Path(__file__).parents[2]

# Every process begins with it; what is written down counts even if the error is caught.
GUARD = """
import os, sys

def refuse(event, arguments):
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "urllib.Request"):
        with open(os.environ["NETWORK_LOG"], "a") as file:
            file.write(f"{event} {arguments}\\n")
        raise RuntimeError("the network is forbidden here")

sys.addaudithook(refuse)
"""

LOADED = {"src", "srcset", "poster", "data"}
"""Attributes whose targets a browser loads by itself; of `link` elements it is `href`."""

NOT_LOADED = {"canonical", "alternate", "next", "prev", "author", "license"}
"""Kinds of links that a browser does not load."""


class Resources(HTMLParser):
    """Collects what a browser loads for a page."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.classes: set[str] = set()
        self.components: set[str] = set()

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attributes}
        self.targets += [values[name] for name in LOADED & set(values)]
        if tag == "link" and not NOT_LOADED & set(values.get("rel", "").split()):
            self.targets.append(values.get("href", ""))
        if tag == "use":
            self.targets += [values.get("href", ""), values.get("xlink:href", "")]
        self.targets += re.findall(r"url\(['\"]?([^'\")]+)", values.get("style", ""))
        self.classes |= set(values.get("class", "").split())
        self.components.add(values.get("data-md-component", ""))


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    (folder / "guard").mkdir()
    (folder / "guard/sitecustomize.py").write_text(GUARD)
    log = folder / "network.log"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(folder / "site")],
        cwd=ROOT,
        env={
            **os.environ,
            "NETWORK_LOG": str(log),
            "NO_MKDOCS_2_WARNING": "1",
            "PYTHONPATH": os.pathsep.join([str(folder / "guard"), *sys.path[1:]]),
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert not log.exists(), log.read_text()
    return folder / "site"


@pytest.mark.slow
def test_no_page_loads_anything_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        found = Resources()
        found.feed(page.read_text("utf-8"))
        assert len(found.targets) > 3 or page.parent.name == "try", page
        outside = [each for each in found.targets if re.match(r"\s*(https?:)?//", each)]
        assert not outside, (page, outside)
        # With these the theme's script would load a library, or ask GitHub for stars.
        assert not {"mermaid", "arithmatex"} & found.classes, page
        assert "source" not in found.components, page


@pytest.mark.slow
def test_no_style_sheet_loads_anything_from_elsewhere(site: Path) -> None:
    sheets = list(site.rglob("*.css"))
    inline = [
        text
        for page in site.rglob("*.html")
        for text in re.findall(r"<style[^>]*>(.*?)</style>", page.read_text("utf-8"), re.S)
    ]
    assert sheets
    for text in [*inline, *(sheet.read_text("utf-8") for sheet in sheets)]:
        assert not re.search(r"url\(\s*['\"]?(https?:)?//", text)
        assert not re.search(r"@import\s+(url\()?\s*['\"]?(https?:)?//", text)


@pytest.mark.slow
def test_no_inline_script_loads_anything_from_elsewhere(site: Path) -> None:
    for page in site.rglob("*.html"):
        for text in re.findall(r"<script[^>]*>(.*?)</script>", page.read_text("utf-8"), re.S):
            assert not re.search(r"(fetch|import|src\s*=|require)\W{0,3}(https?:)?//", text), page


@pytest.mark.slow
def test_pages_hold_what_they_are_made_from(site: Path) -> None:
    def text(name: str) -> str:
        return (site / name).read_text("utf-8")

    assert 'id="deepdetect-doctor"' in text("cli.html")
    assert 'id="deepdetect.DeepDetect"' in text("api/detection.html")
    assert "sub-pixel" in text("api/detection.html")
    for page in site.glob("api/*.html"):  # examples are code, and no quotations in quotations
        assert "<blockquote>" not in page.read_text("utf-8"), page
    assert len(re.findall("Examples:", text("api/detection.html"))) > 3
    assert "deepdetect.integrations.opencv</span>" in text("api/integrations.html")
    assert "jp-OutputArea-output" in text("notebooks/match.html") or "jp-RenderedImage" in text(
        "notebooks/match.html"
    )
    assert "Seven" in text("readme.html")
    assert (site / "images/day-dark-blurred.jpg").is_file()
    assert not list(site.rglob("*.py"))
