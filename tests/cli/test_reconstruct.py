"""`deepdetect reconstruct`: whole files that other readers read, or one sentence and no file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from tests.cli.conftest import one_sentence
from tests.command_line import run_command

from deepdetect import DeepDetect
from deepdetect_lab.datasets import load_motorcycle

FOCAL, OFFSET, BASELINE = 994.978, 31.086, 193.001
"""In pixels and mm, of the page of skimage.data.stereo_motorcycle."""

FILES = [
    *(".deepdetect", "m.glb", "m.html", "m.json", "m.ply"),
    *("m_depth.jpg", "m_depth.npz", "m_depth.png"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rectified pair, the same turned, and all that gives no depth."""
    from skimage import data

    views = data.stereo_motorcycle()[:2]
    folder = tmp_path_factory.mktemp("pairs")
    level = [view[60:360, 250:650] for view in views]
    turned = [
        turn(view, angles) for view, angles in zip(level, ((1, 0, -1), (2, -3, 4)), strict=True)
    ]
    pictures = {
        "left": level[0],
        "right": level[1],
        "turned0": turned[0],
        "turned1": turned[1],
    }
    for name, picture in pictures.items():
        Image.fromarray(picture).save(folder / f"{name}.png")
    calibration = {
        "focal_px": FOCAL,
        "cx": 311.193 - 250,
        "cy": 254.877 - 60,
        "width": 400,
        "height": 300,
        "disparity_offset_px": OFFSET,
        "baseline_mm": BASELINE,
    }
    for name, changes in {
        "calib": {},
        "other-size": {"width": 800},
        "two-focals": {"right": {"focal_px": 1.2 * FOCAL}},
    }.items():
        (folder / f"{name}.json").write_text(json.dumps({**calibration, **changes}))
    return folder


def turn(image: np.ndarray, degrees: tuple[float, ...]) -> np.ndarray:
    """Show an image as its camera sees it after a turn."""
    height, width = image.shape[:2]
    camera = np.array([[FOCAL, 0, (width - 1) / 2], [0, FOCAL, (height - 1) / 2], [0, 0, 1]])
    turned = cv2.Rodrigues(np.radians(np.array(degrees, float)))[0]
    homography = camera @ turned @ np.linalg.inv(camera)
    return cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_CUBIC)


def ply_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh, which reads the files back")
    read = trimesh.load(path)
    return np.asarray(read.vertices), np.asarray(read.colors)[:, :3]


@pytest.fixture(scope="module")
def made(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The files of the rectified pair, and what is printed."""
    output = tmp_path_factory.mktemp("made") / "out"
    words = ["reconstruct", folder / "left.png", folder / "right.png", "--json"]
    words += ["--calibration", folder / "calib.json", "-o", output / "m.ply"]
    result = run_command([*map(str, words)])
    assert result.exit_code == 0, result.output
    return output, json.loads(result.stdout)


def test_pose_prints_rotation_and_translation(folder: Path) -> None:
    words = ["pose", str(folder / "left.png"), str(folder / "turned1.png"), "--focal", str(FOCAL)]
    result = run_command([*words, "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    turned = cv2.Rodrigues(np.radians([2, -3, 4.0]))[0]
    np.testing.assert_allclose(found["R"], turned, atol=0.02)
    # The right camera's centre lies in the direction of x of the left one.
    np.testing.assert_allclose(np.array(found["R"]).T @ found["t"], [-1, 0, 0], atol=0.1)
    assert found["inliers"] > 0.9 * found["matches"] > 500
    plane = run_command(["pose", str(folder / "left.png"), str(folder / "left.png"), *words[3:]])
    assert plane.exit_code == 3


def test_a_rectified_pair_becomes_metric_files(made, folder: Path) -> None:
    output, values = made
    assert sorted(path.name for path in output.iterdir()) == FILES
    assert values == json.loads((output / "m.json").read_text())
    assert values["keypoints"] == len(DeepDetect("dense").detect(folder / "left.png"))
    assert sorted(Path(file).name for file in values["files"]) == FILES[1:]

    assert values["rectified"] is True
    assert values["unit"] == "mm"
    assert values["points"] + sum(values["dropped"].values()) == values["matches"]
    assert values["density"] == pytest.approx(values["points"] / (400 * 300), abs=1e-6)
    assert values["filled"] == 0
    assert values["pose"] is None is values["median_reprojection_error_px"]
    assert values["calibration"]["baseline_mm"] == BASELINE
    assert values["calibration"]["source"].endswith("calib.json")
    assert set(values["seconds"]) >= {"rectified or not", "keypoints", "matching", "files"}

    points, colors = ply_points(output / "m.ply")
    assert len(points) == values["points"] > 30_000
    with np.load(output / "m_depth.npz", allow_pickle=False) as file:
        depth, disparity, matched = file["depth"], file["disparity"], file["matched"]
        assert str(file["unit"]) == "mm"
    known = np.isfinite(depth)
    assert depth.shape == (300, 400)
    np.testing.assert_array_equal(known, np.isfinite(disparity))
    np.testing.assert_array_equal(known, matched)
    np.testing.assert_allclose(
        depth[known], FOCAL * BASELINE / (disparity[known] + OFFSET), rtol=1e-5
    )
    np.testing.assert_allclose(np.sort(points[:, 2]), np.sort(depth[known]), rtol=1e-5)
    assert values["depth"]["50%"] == pytest.approx(np.median(depth[known]), rel=1e-4)
    percentile = np.quantile(disparity[known], 0.95)
    assert values["disparity"]["95%"] == pytest.approx(percentile, rel=1e-4)
    # Each point lies where its pixel looks, and has that pixel's colour.
    picture = np.asarray(Image.open(folder / "left.png"))
    column, row = np.rint(points[:, :2] / points[:, 2:] * FOCAL + [61.193, 194.877]).astype(int).T
    np.testing.assert_array_equal(picture[row, column], colors)
    # Half the angle between the cameras has the tangent of half the baseline over the depth.
    angle = np.degrees(2 * np.arctan(BASELINE / 2 / values["depth"]["50%"]))
    assert values["median_triangulation_angle_degrees"] == pytest.approx(angle, rel=0.05)

    stored = cv2.imread(str(output / "m_depth.png"), cv2.IMREAD_UNCHANGED)
    assert stored.dtype == np.uint16
    step = values["depth_png"]["value_per_unit"]
    assert values["depth_png"]["known_pixels"] == np.count_nonzero(stored) == values["points"]
    np.testing.assert_allclose(stored[known] / step, depth[known], atol=0.51 / step)
    np.testing.assert_array_equal(stored > 0, known)
    assert (output / "m.glb").read_bytes()[:4] == b"glTF"


def test_the_depth_is_true(run, made, folder: Path) -> None:
    true = load_motorcycle().disparity[60:360, 250:650]
    true = FOCAL * BASELINE / (true + OFFSET)
    result = run(
        *("reconstruct", folder / "left.png", folder / "right.png", "--density", 1, "--json"),
        *("--calibration", folder / "calib.json", "-o", "m.glb"),
    )
    output, values = made
    for folder, numbers, least, share in (
        (Path(), json.loads(result.stdout), 0.8, 0.88),
        (output, values, 0.3, 0.96),
    ):
        depth = np.load(folder / "m_depth.npz")["depth"]
        off = np.abs(depth / true - 1)[np.isfinite(depth) & np.isfinite(true)]
        assert (off < 0.01).mean() > share
        assert numbers["density"] > least
        assert (numbers["filled"] > 0) == (folder == Path())


@pytest.mark.slow
def test_a_turned_pair_has_no_scale_and_says_so(run, folder: Path) -> None:
    result = run(
        *("reconstruct", folder / "turned0.png", folder / "turned1.png", "--focal", FOCAL),
        *("-o", "m.html"),
    )
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in Path().iterdir()) == FILES
    values = json.loads(Path("m.json").read_text())
    assert values["rectified"] is False
    assert values["rectification"]["rectified"] is False
    assert values["unit"] == "baseline"
    assert values["calibration"]["source"] == "focal_px"
    assert 0 < values["median_reprojection_error_px"] < 0.2
    assert values["pose"]["angle_degrees"] == pytest.approx(5.9, abs=0.3)
    with np.load("m_depth.npz", allow_pickle=False) as file:
        assert set(file.files) == {"depth", "unit", "matched"}
        assert np.isfinite(file["depth"]).sum() == values["points"] > 10_000


def test_options_reach_the_detector_and_a_name_without_an_ending_is_a_folder(
    run, folder: Path
) -> None:
    pair = folder / "left.png", folder / "right.png", "--focal", FOCAL, "--rectified"
    options = ("--threshold", 0.7, "--weights", "default", "-o", "rec", "--json")
    values = json.loads(run("reconstruct", *pair, *options).stdout)
    expected = DeepDetect("default").detect(folder / "left.png", threshold=0.7)
    assert values["keypoints"] == len(expected)
    assert values["rectified_why"] == "set by the caller"
    assert {path.name for path in Path("rec").glob("*.html")} == {"model.html"}


def test_results_of_other_photographs_are_not_replaced_silently(run, folder: Path) -> None:
    Path("out").mkdir()
    for name in ("m.ply", "m_depth.png"):
        Path("out", name).write_text("mine")
    pair = folder / "left.png", folder / "right.png"
    arguments = ("--focal", FOCAL, "--rectified", "--max-keypoints", 2000, "-o", "out/m.ply")
    assert run("reconstruct", *pair, *arguments).exit_code == 2
    assert [path.read_text() for path in Path("out").iterdir()] == ["mine", "mine"]
    for more in (["--overwrite"], []):  # its own are replaced
        result = run("reconstruct", *pair, *arguments, *more)
        assert result.exit_code == 0, result.output
        assert Path("out/m.ply").read_bytes()[:3] == b"ply"
        assert sorted(path.name for path in Path("out").iterdir()) == FILES
    assert run("reconstruct", pair[0], folder / "turned0.png", *arguments).exit_code == 2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("left right --calibration {}/other-size.json", "800x"),
        ("left right --calibration {}/two-focals.json", "two-focals.json"),
        ("left right --calibration {}/nothing.json", "nothing.json"),
        ("left right", "--focal"),
        ("left right --focal 995 --calibration {}/calib.json", "--calibration"),
        ("right left --calibration {}/calib.json", ""),
        ("left right --focal 995 -o out/m.plyy", "'.ply'"),
    ],
)
def test_one_sentence_and_no_file(run, folder: Path, arguments: str, named: str) -> None:
    """What is told of other pairs without depth is tested in tests/reconstruction."""
    first, second, *more = arguments.format(folder).split()
    output = [] if "-o" in more else ["-o", "out/m.ply"]
    result = run("reconstruct", folder / f"{first}.png", folder / f"{second}.png", *more, *output)
    assert result.exit_code == 2, result.output
    assert one_sentence(result.stderr)
    assert named in result.stderr
    assert not Path("out").exists()
    assert result.stdout == ""


def test_models_of_before_survive_a_failure(
    run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk in the middle of the depth map: what is there stays whole."""
    Path("m_depth.npz").write_bytes(b"of before")

    def fail(file: Any, *arguments: Any, **options: Any) -> None:
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np.lib.format, "write_array", fail)
    result = run(
        *("reconstruct", folder / "left.png", folder / "right.png", "--focal", FOCAL),
        *("--rectified", "--max-keypoints", 500, "-o", "m.ply", "--overwrite"),
    )
    assert result.exit_code == 2
    assert Path("m_depth.npz").read_bytes() == b"of before"
    assert not Path("m.json").exists()
    assert not [path for path in Path().iterdir() if ".part" in path.name]
