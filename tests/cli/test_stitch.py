from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.cli.conftest import one_sentence
from tests.command_line import run_command


@pytest.fixture(scope="module")
def whole() -> np.ndarray:
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    return data.coffee()


@pytest.fixture(scope="module")
def views(whole: np.ndarray) -> list[np.ndarray]:
    """Three overlapping parts of one photograph, (400, 300, 3) each."""
    return [np.ascontiguousarray(whole[:, left : left + 300]) for left in (0, 150, 300)]


@pytest.mark.slow
def test_what_cannot_be_connected_is_told(views: list[np.ndarray], tmp_path: Path) -> None:
    data = pytest.importorskip("skimage.data")
    strange = np.ascontiguousarray(data.rocket()[:300, :300])
    for name, view in zip("abc", (views[0], strange, views[1]), strict=True):
        Image.fromarray(view).save(tmp_path / f"{name}.png")
    files = [str(tmp_path / f"{name}.png") for name in "abc"]
    words = ["stitch", *files, "-o", str(tmp_path / "p.png"), "--reference", files[2]]
    result = run_command([*words, "--json"])
    assert result.exit_code == 1, result.output
    report = json.loads(result.stdout)
    assert [each["image"] for each in report["unregistered"]] == [files[1]]
    assert report["images"] == [files[0], files[2]]
    assert report["reference"] == files[2]
    assert (report["width"], report["height"]) == (450, 400)
    moved = [[1, 0, 150], [0, 1, 0], [0, 0, 1]]
    np.testing.assert_allclose(report["homographies"][1], moved, atol=1e-9)
    assert report["pairs"][0]["images"] == [files[0], files[2]]
    assert report["pairs"][0]["matches"] > 1000
    assert files[1] in run_command(words).stderr


@pytest.fixture
def files(views: list[np.ndarray], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two overlapping photographs in the folder that is worked in."""
    monkeypatch.chdir(tmp_path)
    for name, view in zip("ab", views[:2], strict=True):
        Image.fromarray(view).save(f"{name}.png")
    return [Path("a.png"), Path("b.png")]


def refused(*arguments: object, code: int = 2) -> str:
    result = run_command(["stitch", *map(str, arguments)])
    assert result.exit_code == code, result.output
    assert one_sentence(result.stderr)
    return result.stderr


def test_photographs_are_not_written_over(files: list[Path]) -> None:
    Path("link.png").symlink_to("b.png")
    before = {path: path.read_bytes() for path in files}
    for output in ("a.png", Path("a.png").resolve(), "link.png"):
        refused(*files, "-o", output)
    Path("panorama.jpg").write_bytes(files[0].read_bytes())  # of the time before
    assert "panorama.jpg" in refused(*files, "panorama.jpg")
    assert Path("panorama.jpg").read_bytes() == before[files[0]]
    assert {path: path.read_bytes() for path in files} == before


def test_an_unknown_ending_ends_before_the_work(
    files: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "deepdetect.cli.match.stitch_images", lambda *_, **__: pytest.fail("it worked")
    )
    refused(*files, "-o", "panorama.gif")


@pytest.mark.slow
def test_errors_speak_of_files_and_flags(files: list[Path]) -> None:
    assert "--max-canvas-megapixels" in refused(*files, "--max-canvas-megapixels", "0.1")
    assert "--reference" in refused(*files, "--reference", "c.png")
    data = pytest.importorskip("skimage.data")
    Image.fromarray(data.rocket()[:300, :300]).save("scale.png")
    assert "scale.png" in refused(*files, "scale.png", "--reference", "scale.png", code=3)
    assert not Path("panorama.jpg").exists()


def test_the_file_is_written_and_photographs_that_cannot_be_read_are_listed(
    files: list[Path],
) -> None:
    Path("bad.png").write_bytes(b"no image")
    words = ["stitch", ".", "gone.png", "-o", "p.jpg", "--crop"]
    Path("p.jpg").write_bytes(b"of before")
    words += ["--projection", "cylindrical", "--reference", "b.png", "--json"]
    assert "p.jpg" in refused(*words[1:])
    result = run_command([*words, "--overwrite"])
    assert result.exit_code == 1, result.output
    report = json.loads(result.stdout)
    assert report["images"] == ["a.png", "b.png"]
    assert report["reference"] == "b.png"
    failures = result.stderr.strip().splitlines()[-2:]
    assert [failure.strip() for failure in failures] == report["failures"]
    assert "bad.png" in failures[0]
    assert "gone.png" in failures[1]
    with Image.open("p.jpg") as picture:
        assert picture.format == "JPEG"
        assert picture.size == (report["width"], report["height"])


@pytest.mark.parametrize("bad", ["reference", "all but one"])
def test_too_few_that_can_be_read(bad: str, files: list[Path]) -> None:
    Path("bad.png").write_bytes(b"no image")
    words = ["a.png", "b.png", "bad.png", "--reference", "bad.png"]
    words = words if bad == "reference" else ["a.png", "bad.png"]
    result = run_command(["stitch", *words, "-o", "p.png"])
    assert result.exit_code == 2, result.output
    assert "bad.png" in result.stderr.splitlines()[-1]
    assert not Path("p.png").exists()


@pytest.fixture
def screens(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared: Path) -> list[str]:
    """Screens of a page of text that scrolls under a header that does not."""
    monkeypatch.chdir(tmp_path)
    folder = shared / "cases/stitch-fixed-header/screens"
    return [str(folder / f"{k}.png") for k in (2, 3, 4)]


@pytest.mark.slow
@pytest.mark.filterwarnings("default::UserWarning")
def test_images_that_contradict_each_other_are_written_by_force_only(screens: list[str]) -> None:
    assert run_command(["stitch", *screens, "-o", "page.png"]).exit_code == 3
    assert not Path("page.png").exists()
    result = run_command(["stitch", *screens, "-o", "page.png", "--force", "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["images"] == screens
    assert "contradict" in result.stderr
    assert any(screen in result.stderr for screen in screens)
    assert Path("page.png").exists()
