from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import (
    DeepDetect,
    PointDetector,
    estimate_geometry,
    load_matches,
    match_features,
    match_images,
)
from deepdetect.matching.pipeline import GUIDED_STAGES


def test_writes_matches_and_a_picture(run, photos: Path) -> None:
    result = run("match", photos / "left.png", photos / "right.png", "-o", "out")
    assert result.exit_code == 0, result.output
    stages: list[str] = []
    expected = match_images(photos / "left.png", photos / "right.png", progress=stages.append)
    assert tuple(stages) == GUIDED_STAGES
    with np.load("out/left_right_matches.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["points0"], expected.points0)
        np.testing.assert_array_equal(file["points1"], expected.points1)
        np.testing.assert_array_equal(file["inliers"], expected.inliers)
        np.testing.assert_allclose(file["matrix"], expected.geometry.matrix)
        assert str(file["model"]) == expected.geometry.model
        np.testing.assert_array_equal(file["layer"], expected.layer)
    assert np.asarray(Image.open("out/left_right_matches.jpg")).shape[1] == 400
    assert f"{len(expected):,}" in result.stdout


@pytest.mark.parametrize(
    ("kind", "descriptor", "detector"),
    [
        ("network", (), DeepDetect()),
        ("points", ("--descriptor", "rootsift"), PointDetector(descriptor="rootsift")),
    ],
    ids=["network", "points"],
)
def test_options_reach_the_matcher(
    run, photos: Path, kind: str, descriptor: tuple[str, ...], detector: DeepDetect | PointDetector
) -> None:
    result = run(
        *("match", photos / "left.png", photos / "right.png", "--json", "--no-pictures"),
        *("--ratio", 0.8, "--mutual", "--matcher", "exact", "--model", "fundamental"),
        *("--max-keypoints", 500, "--unguided", "--detector", kind, *descriptor),
    )
    report = json.loads(result.stdout)
    features = [
        detector.extract(photos / name, max_keypoints=500) for name in ("left.png", "right.png")
    ]
    expected = match_features(*features, ratio=0.8, matcher="exact")
    geometry = expected.with_geometry(estimate_geometry(expected)).geometry
    assert report["keypoints0"] == 500
    assert report["matches"] == len(expected)
    np.testing.assert_array_equal(report["geometry"].pop("matrix"), geometry.matrix)
    assert report["geometry"].pop("evidence") == vars(geometry.evidence)
    assert report["geometry"].pop("layers") == []  # unguided matching finds none
    told = {name: getattr(geometry, name) for name in ("model", "scene", "confidence")}
    assert report["geometry"] == told


@pytest.mark.parametrize("way", [("--unguided", "--detector", "points"), ("--model", "homography")])
def test_refined_matches_have_covariances(run, photos: Path, way: tuple[str, ...]) -> None:
    result = run(
        *("match", photos / "left.png", photos / "left.png", "--no-pictures", "--refine", *way),
        *("-o", "out"),
    )
    assert result.exit_code == 0, result.output
    matches = load_matches("out/left_left_matches.npz")
    assert matches.covariances is not None
    assert np.abs(matches.points1 - matches.points0).max() < 0.01


def test_options_of_descriptors_are_for_unguided_matches(run, photos: Path) -> None:
    for words in (("--ratio", 0.8), ("--matcher", "exact"), ("--descriptor", "rootsift")):
        how = ("--detector", "points", *words)
        result = run("match", photos / "left.png", photos / "right.png", *how)
        assert result.exit_code == 2
        assert f"{words[0]} is for --unguided: add that option, or leave" in result.stderr


def test_pairs_of_a_folder_are_those_of_the_images_one_by_one(run, photos: Path) -> None:
    rgb = np.asarray(Image.open(photos / "cat.jpg").convert("RGB"))
    for name, x in (("1", 0), ("2", 8), ("10", 16)):
        (Path("frames") / "a").mkdir(parents=True, exist_ok=True)
        Image.fromarray(rgb[:, x : x + 150]).save(f"frames/a/{name}.png")
    how = ("--detector", "points", "--max-keypoints", 300, "--no-pictures", "--json", "-o", "out")
    found = json.loads(run("match", "frames", *how, "--pairs", "sequential:1").stdout)["pairs"]
    names = [(Path(each["image0"]).stem, Path(each["image1"]).stem) for each in found]
    assert names == [("1", "2"), ("2", "10")]
    one = json.loads(run("match", "frames/a/1.png", "frames/a/2.png", *how).stdout)
    assert Path(found[0]["file"]).name == "a-1_a-2_matches.npz"
    matrix = found[0]["geometry"]["matrix"]
    assert one["geometry"]["matrix"] == matrix
    np.testing.assert_allclose(matrix, [[1, 0, -8], [0, 1, 0], [0, 0, 1]], atol=0.05)
    Path("pairs.txt").write_text("a/10.png a/1.png\n")
    listed = json.loads(run("match", "frames", *how, "--pairs", "pairs.txt").stdout)["pairs"]
    assert [Path(each["image0"]).name for each in listed] == ["10.png"]
    assert len(json.loads(run("match", "frames", *how).stdout)["pairs"]) == 3
    Path("frames/a/2.png").write_bytes(b"no image")
    rest = run("match", "frames", *how)
    assert rest.exit_code == 1
    assert "2 of 3" in rest.stderr
    assert run("match", "frames", "--pairs", "sequential", *how).exit_code == 2
    assert run("match", photos / "cat.jpg", *how).exit_code == 2


def test_the_one_file_that_is_written_may_be_named(run, photos: Path) -> None:
    pair = (photos / "cat.jpg", photos / "cat.jpg", "--detector", "points")
    assert run("match", *pair, "--no-pictures", "-o", "m.csv").exit_code == 0
    assert Path("m.csv").read_text().startswith("x0,y0,x1,y1,score,inlier\n")
    assert run("match", *pair, "-o", "m.npz").exit_code == 2


def test_a_given_homography_judges_and_csv(run, photos: Path) -> None:
    np.savetxt("H", np.eye(3))
    result = run(
        *("match", photos / "cat.jpg", photos / "cat.jpg", "--homography", "H", "--json"),
        *("--no-pictures", "--format", "csv", "--unguided", "--max-keypoints", 300, "-o", "out"),
    )
    report = json.loads(result.stdout)
    assert report["geometry"]["model"] == "homography"
    assert report["inliers"] > 0.9 * report["matches"] > 0
    header, *lines = Path("out/cat_cat_matches.csv").read_text().splitlines()
    assert header == "x0,y0,x1,y1,score,inlier"
    table = np.loadtxt(lines, delimiter=",", ndmin=2)
    assert len(table) == report["matches"]
    assert table[:, 5].sum() == report["inliers"]


def test_images_without_a_match_have_an_exit_code_of_their_own(run, tmp_path: Path) -> None:
    for name in "ab":
        Image.new("RGB", (64, 64), (90, 90, 90)).save(tmp_path / f"{name}.png")
    result = run("match", "a.png", "b.png", "-o", "out", "--unguided", "--json")
    assert result.exit_code == 3
    assert "there are no matches: the images have too little texture" in result.stderr
    report = json.loads(result.stdout)
    assert (report["matches"], report["success"]) == (0, False)


def test_a_failed_estimate_is_said(run, photos: Path) -> None:
    words = ("match", photos / "left.png", photos / "right.png", "-o", "out", "--unguided")
    result = run(*words, "--max-keypoints", 6, "--detector", "points", "--json")
    assert result.exit_code == 3
    assert "no geometry can be trusted: most of these matches by descriptors" in result.stderr
    report = json.loads(result.stdout)
    assert (report["success"], report["geometry"]["model"]) == (False, "none")
    assert report["matches"] > 0 == report["inliers"]
    assert not load_matches(report["file"]).success


def test_a_pair_without_a_geometry_has_its_own_exit_code(run, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for name in "ab":
        noise = rng.integers(0, 256, (64, 80), np.uint8)
        Image.fromarray(noise).save(tmp_path / f"{name}.png")
    result = run("match", "a.png", "b.png", "-o", "out", "--json")
    assert result.exit_code == 3
    assert len(load_matches(Path("out/a_b_matches.npz"))) == 0
    report = json.loads(result.stdout)
    assert (report["matches"], report["success"]) == (0, False)
