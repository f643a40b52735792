"""What a release is checked for before it is made, and the README that indexes show."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

import deepdetect

ROOT = Path(__file__).parents[1]


def load(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def check() -> ModuleType:
    return load(".ci/check_release.py")


def test_links_of_the_readme_work_on_an_index() -> None:
    pytest.importorskip("hatchling", reason="needs hatchling, which builds the wheel")
    hook = load("hatch_build.py")
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


def test_versions_that_differ_are_found(check: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "src/deepdetect").mkdir(parents=True)
    (tmp_path / "src/deepdetect/__init__.py").write_text('__version__ = "0.2.0"\n')
    (tmp_path / "CITATION.cff").write_text("version: 0.2.0\n")
    (tmp_path / "CHANGELOG.md").write_text("## [0.2.0] - 2026-11-24\n")
    assert check.version_problems("0.2.0", tmp_path) == []
    assert len(check.version_problems("0.2.1", tmp_path)) == 3
    (tmp_path / "CHANGELOG.md").write_text("## [Unreleased]\n\n## [0.1.0] - 2026-11-22\n")
    assert check.version_problems("0.2.0", tmp_path) == ["CHANGELOG.md does not name version 0.2.0"]


def test_the_package_and_the_citation_name_one_version(check: ModuleType) -> None:
    assert check.package_version() == deepdetect.__version__
    assert f"version: {deepdetect.__version__}\n" in (ROOT / "CITATION.cff").read_text("utf-8")


def test_what_is_missing_in_a_wheel_is_found(
    check: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import tarfile
    import zipfile

    archive = tmp_path / "deepdetect-1.tar.gz"
    with tarfile.open(archive, "w:gz") as file:
        for name in check.IN_THE_ARCHIVE:
            file.addfile(tarfile.TarInfo(f"deepdetect-1/{name}"))

    def wheel(names: tuple[str, ...], readme: str = "[a](https://example.org)") -> Path:
        path = tmp_path / "deepdetect-1-py3-none-any.whl"
        with zipfile.ZipFile(path, "w") as file:
            for name in names:
                file.writestr(name, "")
            file.writestr("deepdetect-1.dist-info/METADATA", f"Name: deepdetect\n\n{readme}\n")
        return path

    check.check_contents(wheel(check.IN_THE_WHEEL), archive)
    with pytest.raises(SystemExit, match=r"lacks deepdetect/py\.typed"):
        check.check_contents(wheel(check.IN_THE_WHEEL[1:]), archive)
    with pytest.raises(SystemExit, match=r"holds tests/conftest\.py"):
        check.check_contents(wheel((*check.IN_THE_WHEEL, "tests/conftest.py")), archive)
    with pytest.raises(SystemExit, match=r"lead nowhere on an index: docs/a\.md"):
        check.check_contents(wheel(check.IN_THE_WHEEL, "[a](docs/a.md)"), archive)
