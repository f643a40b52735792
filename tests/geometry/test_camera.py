from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect._shared.errors import ReconstructionError
from deepdetect.geometry.camera import Calibration, Camera

SIZE = (640, 480)


def written(tmp_path: Path, values: Any) -> Path:
    path = tmp_path / "calib.json"
    path.write_text(values if isinstance(values, str) else json.dumps(values))
    return path


def test_the_shared_scenes_are_read(shared: Path) -> None:
    from deepdetect.io.image import load_image

    seen = 0
    for path in sorted((shared / "data" / "middlebury").glob("*/calib.json")):
        height, width = load_image(path.parent / "left.png").shape[:2]
        values = json.loads(path.read_text())
        found = Calibration.load(path, (width, height), (width, height))
        assert found.camera0.focal_px == (values["focal_px"],) * 2
        assert found.camera0.centre == ((width - 1) / 2, (height - 1) / 2)
        assert found.baseline_mm == values.get("baseline_mm")
        offset = values.get("disparity_offset_px", 0)
        assert found.disparity_offset_px == pytest.approx(offset)
        if found.baseline_mm:
            depth = values["focal_px"] * values["baseline_mm"] / (30 + offset)
            assert found.depth_mm(30) == pytest.approx(depth)
        seen += 1
    assert seen == 7


def test_the_offset_is_the_distance_of_the_principal_points(tmp_path: Path) -> None:
    """A point of depth z is seen at disparity focal * baseline / z - offset."""
    values = {"focal_px": 900, "baseline_mm": 120, "disparity_offset_px": 31}
    found = Calibration.load(written(tmp_path, values), SIZE, SIZE)
    point = np.array([[50.0, -20.0, 3000.0]])
    left = found.camera0.project(point)
    right = found.camera1.project(point - [120, 0, 0])
    disparity = (left - right)[0]
    assert disparity[1] == 0
    assert found.depth_mm(disparity[0]) == pytest.approx(3000)
    assert disparity[0] == pytest.approx(900 * 120 / 3000 - 31)


def test_views_may_differ(tmp_path: Path) -> None:
    values = {
        "focal_px": [900, 905],
        "cx": 300,
        "cy": 250,
        "left": {"cx": 310},
        "right": {"focal_px": 800, "cx": 340, "width": 600, "height": 400},
    }
    found = Calibration.load(written(tmp_path, values), SIZE, (600, 400))
    assert found.camera0 == Camera(SIZE, (900, 905), (310, 250))
    assert found.camera1 == Camera((600, 400), (800, 800), (340, 250))
    moved = Calibration.load(
        written(tmp_path, {"focal_px": 900, "cx": 300, "disparity_offset_px": 25}), SIZE, SIZE
    )
    assert (moved.camera0.centre, moved.camera1.centre) == ((300, 239.5), (325, 239.5))


@pytest.mark.parametrize(
    "values",
    [
        "{",
        '{"a":' + "[" * 100_000,
        '{"focal_px": ' + "[" * 900 + "]" * 900 + "}",
        '{"focal_px": ' + "9" * 9999 + "}",
        {"focal_px": 900, "disparity_offset_px": 10**400},
        {"focal_px": [[1000, 1000], 3]},
        {},
        {"focal_px": [1, 2, 3]},
        {"focal_px": 900, "baseline_mm": 0},
        {"focal_px": 900, "cx": []},
        {"focal_px": 900, "right": 3},
        {"focal_px": 900, "width": 320, "height": 240},
        {"focal_px": 900, "cx": 300, "right": {"cx": 340}, "disparity_offset_px": 10},
    ],
    ids=lambda values: str(values)[:40],
)
def test_what_is_wrong_is_refused_with_its_file(tmp_path: Path, values: Any) -> None:
    path = written(tmp_path, values)
    with pytest.raises(ReconstructionError, match=path.name) as error:
        Calibration.load(path, SIZE, SIZE)
    assert len(str(error.value)) < 300 + len(str(path))
    with pytest.raises(ReconstructionError):
        Calibration.load(tmp_path / "no.json", SIZE, SIZE)


def test_a_saved_calibration_is_read_exactly(tmp_path: Path) -> None:
    left = Camera(SIZE, (1000 / 3, 700.1), (320.1, 1e-3 / 7))
    for right, baseline in ((left, None), (Camera((600, 400), 1e3 / 7), 193.001)):
        saved = Calibration(left, right, baseline)
        saved.save(tmp_path / "of" / "calib.json")
        found = Calibration.load(tmp_path / "of" / "calib.json")
        assert (found.camera0, found.camera1) == (left, right)
        assert found.baseline_mm == baseline


def test_the_principal_point_is_the_middle_where_none_is_given() -> None:
    camera = Camera(SIZE, 700)
    np.testing.assert_array_equal(camera.matrix, [[700, 0, 319.5], [0, 700, 239.5], [0, 0, 1]])
    for focal in (0, -1, float("nan"), float("inf")):
        with pytest.raises(ReconstructionError):
            Camera(SIZE, focal)


def test_rays_and_projection_undo_each_other() -> None:
    camera = Camera(SIZE, (700, 720), (300, 250))
    pixels = np.random.default_rng(0).uniform(0, SIZE, (50, 2))
    np.testing.assert_allclose(camera.project(camera.rays(pixels) * 3), pixels)


def test_the_size_of_the_images_is_checked() -> None:
    calibration = Calibration(Camera(SIZE, 700), Camera(SIZE, 700))
    calibration.check_sizes(SIZE, SIZE)
    with pytest.raises(ReconstructionError, match="320x240"):
        calibration.check_sizes(SIZE, (320, 240))


@pytest.mark.parametrize(
    ("values", "sizes"),
    [
        ({"width": 640, "height": 480, "right": {"width": 600, "height": 400}}, (SIZE, (600, 400))),
        (
            {"left": {"width": 640, "height": 480}, "right": {"width": 600, "height": 400}},
            (SIZE, (600, 400)),
        ),
        ({"left": {"width": 640, "height": 480}}, (SIZE, SIZE)),
        ({"width": 640, "height": 480}, (SIZE, SIZE)),
    ],
)
def test_sizes_are_those_of_the_file_where_none_are_given(
    tmp_path: Path, values: dict[str, Any], sizes: tuple[tuple[int, int], ...]
) -> None:
    found = Calibration.load(written(tmp_path, {"focal_px": 900, **values}))
    assert (found.camera0.size, found.camera1.size) == sizes
    for camera, (width, height) in zip((found.camera0, found.camera1), sizes, strict=True):
        assert camera.centre == ((width - 1) / 2, (height - 1) / 2)
    given = Calibration.load(written(tmp_path, {"focal_px": 900, **values}), *sizes)
    assert (given.camera0, given.camera1) == (found.camera0, found.camera1)
