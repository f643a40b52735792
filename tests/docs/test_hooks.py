"""What is made for the site from the code and from files beside docs/."""

from __future__ import annotations

import re
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

import deepdetect

ROOT = Path(__file__).parents[2]
GITHUB = "https://github.com/deepdetect/deepdetect/blob/main/"


@pytest.mark.parametrize(
    ("origin", "uri", "link", "turned"),
    [
        ("docs/index.md", "index.md", "../README.md#use", "readme.md#use"),
        ("docs/index.md", "index.md", "matching.md#limits", "matching.md#limits"),
        ("docs/index.md", "index.md", "#here", "#here"),
        ("docs/index.md", "index.md", "https://arxiv.org/abs/1", "https://arxiv.org/abs/1"),
        ("docs/index.md", "index.md", "../examples/onnx_cpp", f"{GITHUB}examples/onnx_cpp"),
        ("README.md", "readme.md", "docs/many-images.md", "many-images.md"),
        ("README.md", "readme.md", "docs/images/demo.jpg", "images/demo.jpg"),
        ("README.md", "readme.md", "LICENSE", f"{GITHUB}LICENSE"),
        (
            "src/deepdetect/detector/weights/MODEL_CARD.md",
            "cards/default.md",
            "../../../../docs/history.md",
            "../history.md",
        ),
        (
            "docs/points.md",
            "points.md",
            "../src/deepdetect/detector/points/MODEL_CARD.md",
            "cards/points.md",
        ),
        ("docs/api/detection.md", "api/detection.md", "../python.md#detect", "../python.md#detect"),
    ],
)
def test_links_lead_to_pages_of_the_site_or_to_github(
    hooks: ModuleType, origin: str, uri: str, link: str, turned: str
) -> None:
    assert hooks.turn_links(f"see [this]({link}).", origin, uri) == f"see [this]({turned})."
    assert hooks.turn_links(f"x\n\n[name]: {link}\n", origin, uri) == f"x\n\n[name]: {turned}\n"


def test_links_in_code_stay(hooks: ModuleType) -> None:
    text = "`[a](../b.md)`\n\n```md\n[a](../b.md)\n```\n"
    assert hooks.turn_links(text, "docs/index.md", "index.md") == text


def test_the_page_in_the_browser_is_embedded_where_it_is_there(
    hooks: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (ROOT / "docs/index.md").read_text("utf-8")
    assert hooks.APP_MARK in text
    page = SimpleNamespace(file=SimpleNamespace(src_uri="index.md"))
    monkeypatch.setattr(hooks, "APP", tmp_path)
    assert "iframe" not in hooks.on_page_markdown(text, page)
    (tmp_path / "index.html").write_text("<p>app</p>")
    assert '<iframe src="try/index.html"' in hooks.on_page_markdown(text, page)


def test_notebooks_load_nothing_from_elsewhere(hooks: ModuleType) -> None:
    html = '<p>a</p><script type="module">\nimport("https://example.org/a.js")\n</script><p>b</p>'
    page, notebook = (
        SimpleNamespace(file=SimpleNamespace(src_uri=uri)) for uri in ("a.md", "a.ipynb")
    )
    assert hooks.on_page_content(html, page) == html
    assert hooks.on_page_content(html, notebook) == "<p>a</p><p>b</p>"
    badge = '<a href="https://example.org"><img alt="x" src="https://example.org/a.svg" /></a>'
    shown = '<a href="https://example.org">Open in Colab</a>'
    assert hooks.on_page_content(badge, notebook) == shown


def test_every_page_is_in_the_navigation(hooks: ModuleType) -> None:
    listed = set(re.findall(r": ([\w/-]+\.(?:md|ipynb))$", navigation(), re.M))
    docs = ROOT / "docs"
    pages = {path.name for path in docs.glob("*.md")} | set(hooks.COPIED.values()) | {"cli.md"}
    pages |= {f"notebooks/{path.name}" for path in docs.glob("notebooks/*.ipynb")}
    assert listed == pages - {"history.md", "benchmark-report.md"}


def navigation() -> str:
    return (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]


def test_every_exported_name_is_on_one_page_of_the_interface(hooks: ModuleType) -> None:
    names = [name for page in hooks.api_pages.PAGES for name in page.names]
    assert len(names) == len(set(names))
    exported = set(deepdetect.__all__) - {"__version__"}
    assert exported == {name for name in names if "." not in name} - hooks.api_pages.WHOLE_PACKAGES
    drop_ins = {
        path.stem
        for path in (ROOT / "src/deepdetect/integrations").glob("*.py")
        if re.search(rf"^### {path.stem}$", INTEGRATIONS, re.M | re.I)
    }
    modules = {name for name in names if name.startswith("integrations.")}
    assert {name.partition(".")[2] for name in modules} == drop_ins


INTEGRATIONS = (ROOT / "docs/other-programs.md").read_text("utf-8")


def test_the_page_of_commands_has_all_of_them_with_all_options(hooks: ModuleType) -> None:
    page = hooks.cli_page.make_page()
    sections = dict(re.findall(r"^## (deepdetect [^\n]+)\n(.*?)(?=^## |\Z)", page, re.S | re.M))
    commands = dict(hooks.cli_page.walk())
    assert list(sections) == list(commands)
    assert {"deepdetect detect", "deepdetect export colmap"} < {*commands}
    for name, app in commands.items():
        rows = re.findall(r"^\| `(.+?)` \| (.+) \|$", sections[name], re.M)
        arguments = [each for each in app.assemble_argument_collection() if each.show]
        assert [flags.split(", ") for flags, _ in rows] == [[*each.names] for each in arguments]
        assert all(text.strip() for _, text in rows)
    assert "\\_matches.npz" in page  # no emphasis between two underscores
