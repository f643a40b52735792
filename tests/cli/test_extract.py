from __future__ import annotations

import json
from pathlib import Path

import pytest
from tests.cli.conftest import one_sentence


@pytest.fixture(autouse=True)
def _h5py() -> None:
    pytest.importorskip("h5py", reason="needs h5py")


def shapes(path: str) -> dict[str, tuple[int, ...]]:
    import h5py

    with h5py.File(path) as file:
        return {name: group["descriptors"].shape for name, group in file.items()}


def test_extract_and_match(run, photos: Path) -> None:
    result = run("extract", photos, "-o", "f.h5", "--max-keypoints", 200, "--workers", 1)
    assert result.exit_code == 0, result.output
    assert "3 images with 600 keypoints, 0 already done -> f.h5" in result.stdout
    assert shapes("f.h5") == dict.fromkeys(("cat.jpg", "left.png", "right.png"), (64, 200))
    again = json.loads(
        run("extract", photos, "-o", "f.h5", "--max-keypoints", 200, "--json").stdout
    )
    assert (again["images"], again["skipped"]) == ([], 3)
    words = ("match-many", "f.h5", "--workers", 1, "--pairs")
    result = run(*words, "exhaustive", "--json")
    assert result.exit_code == 0, result.output
    matches = {tuple(m["pair"]): m["matches"] for m in json.loads(result.stdout)["matches"]}
    assert matches["left.png", "right.png"] > 3 * matches["cat.jpg", "left.png"]
    assert len(matches) == 3
    result = run(*words, "sequential:1")
    assert "0 pairs with 0 matches, 2 already done -> matches.h5" in result.stdout
    Path("pairs.txt").write_text("left.png right.png\n")
    assert "0 pairs with 0 matches, 1 already done" in run(*words, "pairs.txt").stdout


@pytest.mark.parametrize(
    ("flags", "least", "most"),
    [
        ((), 500, 2048),
        (("--detector", "network"), 5000, 32_000),
        (("--detector", "network", "--max-keypoints", 99), 99, 99),
    ],
)
def test_how_many_keypoints(run, photos: Path, flags: tuple, least: int, most: int) -> None:
    Path("in").mkdir()
    Path("in/left.png").write_bytes((photos / "left.png").read_bytes())
    assert run("extract", "in", *flags, "--workers", 1).exit_code == 0
    assert least <= shapes("features.h5")["left.png"][1] <= most


def test_a_bad_image_is_listed_at_the_end(run, photos: Path) -> None:
    Path("in").mkdir()
    Path("in/bad.jpg").write_bytes(b"not a photograph")
    Path("in/good.png").write_bytes((photos / "left.png").read_bytes())
    result = run("extract", "in", "--max-keypoints", 9, "--workers", 1)
    assert result.exit_code == 1
    assert "bad.jpg" in result.stderr.splitlines()[-1]
    Path("pairs.txt").write_text("good.png bad.jpg\n")
    result = run("match-many", "features.h5", "--pairs", "pairs.txt")
    assert result.exit_code == 2
    assert "bad.jpg" in result.stderr


def test_no_file_is_named_that_is_not_there(run, photos: Path) -> None:
    Path("in").mkdir()
    Path("in/left.png").write_bytes((photos / "left.png").read_bytes())
    result = run("extract", "in", "--max-megapixels", "0.001", "--workers", 1)
    assert result.exit_code == 2
    assert "features.h5" not in result.stdout
    assert not Path("features.h5").exists()
    # The failed start does not stand in the way of another one.
    assert run("extract", "in", "--max-keypoints", 9, "--workers", 1).exit_code == 0
    Path("pairs.txt").write_text("left.png no.png\n")
    result = run("match-many", "features.h5", "--pairs", "pairs.txt", "--workers", 1)
    assert result.exit_code == 2
    assert "matches.h5" not in result.stdout


@pytest.mark.parametrize(
    "words",
    [
        "extract nowhere",
        f"extract {__file__}",
        "extract {photos} --workers 0",
        "match-many no.h5 --pairs no.txt",
        "label {photos} -o masks --engine rai",
    ],
)
def test_a_mistake_leaves_nothing(run, photos: Path, words: str) -> None:
    result = run(*words.format(photos=photos).split())
    assert result.exit_code == 2
    assert one_sentence(result.stderr)
    assert list(Path().iterdir()) == []
