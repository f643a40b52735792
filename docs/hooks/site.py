"""Extensions of mkdocs: pages generated from the code, and pages from files outside of `docs`.

The pages of `docs` link to each other and to files of the repository, so that they work on GitHub.
For the site these links are changed to the page made from a file, or to the file on GitHub.
"""

from __future__ import annotations

import os
import posixpath
import re
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(Path(__file__).parent))

import api_pages  # noqa: E402
import cli_page  # noqa: E402

REPOSITORY = "https://github.com/deepdetect/deepdetect/blob/main/"

COPIED = {
    "README.md": "readme.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "src/deepdetect/detector/weights/MODEL_CARD.md": "cards/default.md",
    "src/deepdetect/detector/weights/DENSE_CARD.md": "cards/dense.md",
    "src/deepdetect/detector/weights/FREE_CARD.md": "cards/free.md",
    "src/deepdetect/detector/points/MODEL_CARD.md": "cards/points.md",
}
"""Files of the repository that become pages of the site, with the paths of these pages."""

APP = ROOT / "web" / "dist"
"""Folder of the page that detects and matches in the browser, if it is built."""

API_BOOST = 0.5
"""Search weight of the API pages; other pages have 1, so that guides come first. Chosen by hand."""

APP_FOLDER = "try"
APP_MARK = "<!-- The page in the browser is embedded here. -->"
EMBEDDED = f"""\
<iframe src="{APP_FOLDER}/index.html" class="app" title="DeepDetect in the browser" loading="lazy">
</iframe>

It runs in this page, on your computer: your images stay there. \
<a href="{APP_FOLDER}/index.html">The page by itself</a>.
"""

ORIGINS: dict[str, str] = {site: repository for repository, site in COPIED.items()}


def on_config(config: Any) -> Any:
    """Complete the configuration: the site's address, anchors, and the API pages."""
    from pymdownx.slugs import slugify

    config.site_url = os.environ.get("SITE_URL", "")
    # Anchors must be those of GitHub, where the same pages are read.
    config.mdx_configs["toc"]["slugify"] = slugify(case="lower")
    config.nav = _navigation(config.nav)
    return config


def _navigation(entries: list[Any]) -> list[Any]:
    pages = []
    for entry in entries:
        ((title, target),) = entry.items()
        if target == "api/":
            target = [{page.title: page.uri} for page in api_pages.PAGES]
        elif isinstance(target, list):
            target = _navigation(target)
        pages.append({title: target})
    return pages


def on_files(files: Any, config: Any) -> Any:
    """Add the pages generated from the code or from files outside of `docs`, and the app."""
    from mkdocs.structure.files import File

    for repository, site in COPIED.items():
        text = (ROOT / repository).read_text("utf-8")
        files.append(File.generated(config, site, content=without_badges(text)))
    files.append(File.generated(config, "cli.md", content=cli_page.make_page()))
    for page in api_pages.PAGES:
        files.append(File.generated(config, page.uri, content=page.text()))
    if (APP / "index.html").is_file():
        for path in sorted(APP.rglob("*")):
            if path.is_file() and path.suffix != ".md":
                uri = f"{APP_FOLDER}/{path.relative_to(APP).as_posix()}"
                files.append(File.generated(config, uri, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Convert links, and embed the app."""
    uri = page.file.src_uri
    if uri.startswith("api/"):
        page.meta["search"] = {"boost": API_BOOST}
    embedded = EMBEDDED if (APP / "index.html").is_file() else ""
    markdown = markdown.replace(APP_MARK, embedded)
    return turn_links(markdown, ORIGINS.get(uri, f"docs/{uri}"), uri)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Remove scripts and badges from notebooks: both are loaded from other servers."""
    if not page.file.src_uri.endswith(".ipynb"):
        return html
    html = re.sub(r'<img[^>]*src="https://[^>]*>', "Open in Colab", html)
    return re.sub(r"<script.*?</script>", "", html, flags=re.S)


def turn_links(markdown: str, origin: str, uri: str) -> str:
    """Convert a page's links to files of the repository.

    Args:
        markdown: text of the page.
        origin: path of the page in the repository, to which its links are relative.
        uri: path of the page in the site.

    Returns:
        The page with links to pages of the site, and to GitHub for all other files.

    Example:
        >>> turn_links("[a](../README.md#use), [b](../Makefile)", "docs/a.md", "a.md")
        '[a](readme.md#use), [b](https://github.com/deepdetect/deepdetect/blob/main/Makefile)'
    """

    def turn(match: re.Match[str]) -> str:
        path, hash_sign, anchor = match["target"].partition("#")
        if not path or re.match(r"[a-z]+:", path):
            return match[0]
        file = posixpath.normpath(posixpath.join(posixpath.dirname(origin), path))
        site = COPIED.get(file)
        if site is None and file.startswith("docs/"):
            site = file.removeprefix("docs/")
        if site is None:
            return f"{match['before']}{REPOSITORY}{file}{hash_sign}{anchor}"
        near = posixpath.relpath(site, posixpath.dirname(uri) or ".")
        return f"{match['before']}{near}{hash_sign}{anchor}"

    link = re.compile(r"(?P<before>\]\(|^\[[^\]^]+\]: )(?P<target>[^)\s]+)", re.M)
    # Code is not changed.
    parts = re.split(r"(^```.*?^```$|`[^`\n]+`)", markdown, flags=re.S | re.M)
    parts[::2] = [link.sub(turn, part) for part in parts[::2]]
    return "".join(parts)


def without_badges(text: str) -> str:
    """Remove the badges of the README: their images are on another server."""
    return re.sub(r"^\[!\[.*\n", "", text, count=1, flags=re.M)
