from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

pytest.importorskip("h5py", reason="needs h5py")

from tests.command_line import run_command

from deepdetect.sfm.colmap import import_pycolmap


@pytest.fixture(scope="module")
def made(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files of `extract`, `match-many`, `detect` and `match`."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "pairs.txt").write_text("left.png right.png\n")
    pair = (photos / "left.png", photos / "right.png")
    files = {name: folder / name for name in ("f.h5", "m.h5", "pairs.txt", "out")}
    for words in (
        ("extract", photos, "-o", files["f.h5"], "--workers", 1),
        ("match-many", files["f.h5"], "--pairs", files["pairs.txt"], "-o", files["m.h5"]),
        ("match", *pair, "-o", files["out"], "--no-pictures"),
        ("detect", photos / "cat.jpg", "-o", files["out"], "--no-pictures", "--density", 0.01),
    ):
        result = run_command(list(map(str, words)))
        assert result.exit_code == 0, result.output
    return folder


@pytest.fixture
def saved(made: Path, run, tmp_path: Path) -> Path:
    """These files in the folder of the test."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    return tmp_path


def summary(result) -> dict[str, object]:
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.mark.parametrize(
    ("form", "files"),
    [
        ("colmap", {"made"}),
        ("hloc", {"features.h5", "matches.h5", "pairs.txt"}),
    ],
)
def test_saved_files_in_all_formats(
    run, saved: Path, photos: Path, form: str, files: set[str]
) -> None:
    if form == "colmap":
        pytest.importorskip("pycolmap", reason="needs pycolmap")
        files = {"made.db"}
    output = "made.db" if form == "colmap" else "made"
    many = summary(
        run("export", form, "f.h5", "--matches", "m.h5", "--images", photos, "-o", output, "--json")
    )
    assert (many["images"], many["pairs"]) == (3, 1)
    assert {Path(file).name for file in many["files"]} == files
    npz = ("out/left_right_matches.npz", "out/cat.npz")
    one = summary(run("export", form, *npz, "--images", photos, "-o", f"npz-{output}", "--json"))
    assert (one["images"], one["pairs"]) == (3, 1)
    assert one["matches"] > many["matches"] > 50


def test_straight_from_photographs(run, photos: Path, tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="needs pycolmap")
    Path("in").mkdir()
    for name in ("left.png", "right.png"):
        shutil.copy(photos / name, "in")
    words = ("export", "colmap", "in", "--max-keypoints", 300, "--workers", 1, "-o")
    made = summary(run(*words, "d.db", "--focal", 995, "--json"))
    assert (made["images"], made["pairs"]) == (2, 1)
    with import_pycolmap().Database.open(tmp_path / "d.db") as database:
        assert {camera.params[0] for camera in database.read_all_cameras()} == {995}
        assert database.num_verified_image_pairs() == 1
        assert max(len(database.read_keypoints(k)) for k in (1, 2)) <= 300
    result = run(*words, "e.db", "--no-verify", "--pairs", "sequential:1")
    assert result.exit_code == 0, result.output
    with import_pycolmap().Database.open(tmp_path / "e.db") as database:
        assert database.num_verified_image_pairs() == 0
        assert database.num_matched_image_pairs() == 1


def test_text_files_of_colmap(run, saved: Path, photos: Path) -> None:
    made = summary(run("export", "colmap", "f.h5", "--matches", "m.h5", "-o", "text", "--json"))
    assert "text/cat.jpg.txt" in made["files"]
    header = (saved / "text/left.png.txt").read_text().split("\n")[0]
    assert header.endswith(" 128")
    assert run("export", "colmap", "f.h5", "-o", "text2", "--focal", 9).exit_code == 2


def test_nothing_is_replaced_silently(run, saved: Path) -> None:
    (saved / "full").mkdir()
    (saved / "full" / "features.txt").write_text("mine")
    assert run("export", "hloc", "f.h5", "-o", "full").exit_code == 2
    assert (saved / "full" / "features.txt").read_text() == "mine"
    assert run("export", "hloc", "f.h5", "-o", "full", "--overwrite").exit_code == 0
    assert run("export", "hloc", "f.h5", "-o", "full").exit_code == 0  # our own
    assert run("export", "hloc", "out/cat.npz", "-o", "full").exit_code == 2


@pytest.mark.parametrize(
    "words",
    [
        "colmap none.h5 -o a.db",
        "colmap pairs.txt -o a.db",
        "colmap f.h5 -o a.txt",
        "colmap f.h5 -o a.db --focal 9 --calibration c.json",
        "colmap {photos} -o a.db --matches m.h5",
        "hloc f.h5 -o a --pairs pairs.txt",
        "colmap out/cat.npz -o a",
        "hloc {photos} -o a --pairs none.txt",
    ],
)
def test_a_mistake_leaves_nothing(run, saved: Path, photos: Path, words: str) -> None:
    before = {path.name for path in saved.iterdir()}
    shutil.rmtree(saved / "out" / ".deepdetect")  # of what was saved
    result = run("export", *(word.format(photos=photos) for word in words.split()))
    assert result.exit_code == 2, result.output
    assert {path.name for path in saved.iterdir()} == before
    assert not list(saved.rglob(".deepdetect"))


def test_a_bad_photograph_does_not_stop_the_export(run, photos: Path, tmp_path: Path) -> None:
    """The others are written; it is named at the end, with exit code 1."""
    (tmp_path / "photos").mkdir()
    shutil.copy(photos / "left.png", "photos")
    (tmp_path / "photos" / "broken.jpg").write_bytes(b"no image")
    words = ("photos", "--max-keypoints", 200, "--workers", 1)
    result = run("export", "hloc", *words, "-o", "made", "--json")
    assert result.exit_code == 1, result.output
    assert "broken.jpg" in result.stderr
    made = json.loads(result.stdout)
    assert (made["images"], made["pairs"], len(made["failures"])) == (1, 0, 1)
    assert (tmp_path / "made" / "features.h5").is_file()
    result = run("export", "hloc", *words, "-o", "small", "--max-megapixels", 0.001)
    assert result.exit_code == 1
    assert "--max-megapixels" in result.stderr
