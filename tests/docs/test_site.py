"""The site is built strictly, without the network, and its pages load nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
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

LOADED = re.compile(
    r"""<(?!a\b)[^>]*\s(?:src|srcset|poster|data)=["']?\s*(?:https?:)?//"""
    r"""|<link[^>]*rel=["']?(?:stylesheet|preload|icon|manifest)[^>]*href=["']?\s*(?:https?:)?//"""
    r"""|(?:url\(|@import)\s*['"]?(?:https?:)?//"""
)
"""What a browser loads by itself, of pages and of style sheets."""


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "guard").mkdir()
    (tmp_path / "guard/sitecustomize.py").write_text(GUARD)
    log, site = tmp_path / "network.log", tmp_path / "site"
    paths = os.pathsep.join([str(tmp_path / "guard"), *sys.path[1:]])
    known = {"NETWORK_LOG": str(log), "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": paths}
    words = [sys.executable, "-m", "mkdocs", "build", "--site-dir", str(site)]
    done = subprocess.run(words, cwd=ROOT, env=os.environ | known, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    assert not log.exists(), log.read_text()
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for path in [*pages, *site.rglob("*.css")]:
        assert not LOADED.search(path.read_text("utf-8")), path
