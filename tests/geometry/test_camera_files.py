"""Files of cameras, each as the program of its format writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from deepdetect._shared.errors import ReconstructionError
from deepdetect.geometry.camera import Calibration

SIZE = (640, 480)
LEFT = np.array([[500.0, 0, 310.5], [0, 502.0, 242.25], [0, 0, 1]])
RIGHT = np.array([[500.0, 0, 326.0], [0, 502.0, 242.25], [0, 0, 1]])
BASELINE_MM = 120.0


def projection(matrix: np.ndarray, right_mm: float, unit_mm: float) -> np.ndarray:
    column = [-matrix[0, 0] * right_mm / unit_mm, 0, 0]
    return np.column_stack([matrix, column])


def line(matrix: np.ndarray) -> str:
    return " ".join(f"{number:.12e}" for number in matrix.ravel())


def opencv(path: Path, **values: Any) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value)
    storage.release()
    return path


ZEROS = np.zeros((1, 5))
MOVED_M = np.array([[-BASELINE_MM / 1000], [0.0], [0.0]])


def ros(
    matrix: np.ndarray, right_mm: float, distortion: str = "-0.36, 0.11, 0.001, 0.0005, 0.0"
) -> str:
    raw = matrix + [[9, 0, 5], [0, 9, 5], [0, 0, 0]] if distortion[0] == "-" else matrix

    def rows(name: str, values: np.ndarray) -> str:
        numbers = ", ".join(f"{value:.6f}" for value in values.ravel())
        return f"{name}:\n  rows: {len(values)}\n  cols: {values.shape[1]}\n  data: [{numbers}]\n"

    return (
        "image_width: 640\nimage_height: 480\ncamera_name: narrow_stereo/left\n"
        + rows("camera_matrix", raw)
        + "distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n"
        + f"  data: [{distortion}]\n"
        + rows("rectification_matrix", np.eye(3))
        + rows("projection_matrix", projection(matrix, right_mm, 1000))
    )


def kalibr(distortion: str = "0.0, 0.0, 0.0, 0.0", model: str = "pinhole") -> str:
    def camera(matrix: np.ndarray) -> str:
        (fx, _, cx), (_, fy, cy), _ = matrix
        return (
            f"  camera_model: {model}\n  distortion_coeffs: [{distortion}]\n"
            f"  distortion_model: radtan\n  intrinsics: [{fx}, {fy}, {cx}, {cy}]\n"
            "  resolution: [640, 480]\n  rostopic: /cam0/image_raw\n"
        )

    return (
        f"cam0:\n  cam_overlaps: [1]\n{camera(LEFT)}  timeshift_cam_imu: 0.0\n"
        "cam1:\n  T_cn_cnm1:\n  - [1.0, 0.0, 0.0, -0.12]\n  - [0.0, 1.0, 0.0, 0.0]\n"
        f"  - [0.0, 0.0, 1.0, 0.0]\n  - [0.0, 0.0, 0.0, 1.0]\n{camera(RIGHT)}"
    )


def euroc(matrix: np.ndarray, x_m: float, distortion: str = "0, 0, 0, 0") -> str:
    (fx, _, cx), (_, fy, cy), _ = matrix
    return (
        "%YAML:1.0\n# General sensor definitions.\nsensor_type: camera\n"
        "comment: VI-Sensor cam0 (MT9M034)\n\n# Sensor extrinsics wrt. the body-frame.\nT_BS:\n"
        f"  cols: 4\n  rows: 4\n  data: [1.0, 0.0, 0.0, {x_m},\n         0.0, 1.0, 0.0, -0.06,\n"
        "        0.0, 0.0, 1.0, 0.0098,\n         0.0, 0.0, 0.0, 1.0]\n\nrate_hz: 20\n"
        "resolution: [640, 480]\ncamera_model: pinhole\n"
        f"intrinsics: [{fx}, {fy}, {cx}, {cy}] #fu, fv, cu, cv\n"
        f"distortion_model: radial-tangential\ndistortion_coefficients: [{distortion}]\n"
    )


def kitti(left: str, right: str, start: str = "") -> str:
    views = (projection(LEFT, 0, 1000), projection(RIGHT, BASELINE_MM, 1000))
    return start + "".join(f"{k}: {line(v)}\n" for k, v in zip((left, right), views, strict=True))


MIDDLEBURY = (
    "cam0=[500 0 310.5; 0 502 242.25; 0 0 1]\ncam1=[500 0 326; 0 502 242.25; 0 0 1]\ndoffs=15.5\n"
    "baseline=120\nwidth=640\nheight=480\nndisp=280\nisint=0\nvmin=31\nvmax=257\ndyavg=0.918\n"
)
COLMAP = (
    "# Camera list with one line of data per camera:\n"
    "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    "# Number of cameras: 2\n1 PINHOLE 640 480 500 502 311 242.75\n"
    "2 OPENCV 640 480 500 502 326.5 242.75 0 0 0 0\n"
)
KITTI_RAW = (
    "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\nS_00: 1.392000e+03 5.12e+02\n"
    "S_rect_02: 6.400000e+02 4.800000e+02\n"
)

PAIRS: dict[str, str] = {
    "Middlebury": MIDDLEBURY,
    "Kalibr": kalibr(),
    "KITTI odometry": kitti("P0", "P1"),
    "KITTI odometry, Windows": kitti("P0", "P1").replace("\n", "\r\n"),
    "KITTI raw": kitti("P_rect_02", "P_rect_03", KITTI_RAW),
    "COLMAP": COLMAP,
}


def check(found: Calibration, baseline_mm: float | None = BASELINE_MM) -> None:
    np.testing.assert_allclose(found.camera0.matrix, LEFT)
    np.testing.assert_allclose(found.camera1.matrix, RIGHT)
    assert found.disparity_offset_px == pytest.approx(15.5)
    assert found.baseline_mm == (None if baseline_mm is None else pytest.approx(baseline_mm))
    assert found.camera0.size == found.camera1.size == SIZE
    if baseline_mm is not None:
        # A point at 3 m is seen at a disparity of f B / z - offset.
        assert found.depth_mm(np.array([500 * baseline_mm / 3000 - 15.5]))[0] == pytest.approx(3000)


@pytest.mark.parametrize("name", PAIRS)
def test_files_of_pairs(name: str, tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_bytes(PAIRS[name].encode())
    check(Calibration.load(path, SIZE, SIZE), None if name == "COLMAP" else BASELINE_MM)


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
def test_files_that_opencv_writes(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"stereo.{ending}"
    rectified = {"P1": projection(LEFT, 0, 1), "P2": projection(RIGHT, BASELINE_MM, 1)}
    distorted = {"M1": LEFT + 9 * np.eye(3), "D1": ZEROS - 0.2, "M2": RIGHT, "D2": ZEROS}
    check(Calibration.load(opencv(path, **distorted, **rectified), SIZE, SIZE))
    plain = {"M1": LEFT, "D1": ZEROS, "M2": RIGHT, "D2": ZEROS, "T": MOVED_M}
    check(Calibration.load(opencv(path, **plain), SIZE, SIZE))
    check(Calibration.load(opencv(path, **{**plain, "T": MOVED_M * 1000}), SIZE, SIZE))
    with pytest.raises(ReconstructionError):
        Calibration.load(opencv(path, **distorted), SIZE, SIZE)
    one = {"image_width": 640, "image_height": 480, "camera_matrix": LEFT}
    found = Calibration.load(opencv(path, **one, distortion_coefficients=ZEROS))
    assert found.camera0 == found.camera1
    np.testing.assert_allclose(found.camera0.matrix, LEFT)
    assert found.camera0.size == SIZE
    assert found.baseline_mm is None


def test_folders_of_two_files(tmp_path: Path) -> None:
    for name, first, second, texts in (
        ("ros", "left.yaml", "right.yaml", (ros(LEFT, 0), ros(RIGHT, BASELINE_MM))),
        ("euroc", "cam0/sensor.yaml", "cam1/sensor.yaml", (euroc(LEFT, -0.02), euroc(RIGHT, 0.1))),
    ):
        for file, text in zip((first, second), texts, strict=True):
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).write_text(text)
        check(Calibration.load(tmp_path / name))
    folder = tmp_path / "opencv"
    folder.mkdir()
    opencv(folder / "intrinsics.yml", M1=LEFT, D1=ZEROS, M2=RIGHT, D2=ZEROS)
    opencv(folder / "extrinsics.yml", R=np.eye(3), T=MOVED_M)
    check(Calibration.load(folder, SIZE))


ROSTOPIC = """header:
  seq: 12
  frame_id: "camera"
height: 480
width: 640
distortion_model: "plumb_bob"
D: [0.0, 0.0, 0.0, 0.0, 0.0]
K: [500.0, 0.0, 310.5, 0.0, 502.0, 242.25, 0.0, 0.0, 1.0]
R: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
roi:
  x_offset: 0
  do_rectify: False
"""
ROS2 = "height: 480\nwidth: 640\nd:\n- 0.0\n- 0.0\nk:\n" + "".join(f"- {v}\n" for v in LEFT.ravel())
SINGLE = {
    "ROS": ros(LEFT, 0, "0.0, 0.0, 0.0, 0.0, 0.0"),
    "rostopic echo": ROSTOPIC + "---\n",
    "ros2 topic echo": ROS2 + "---\n",
    "EuRoC": euroc(LEFT, 0.1),
    "K.txt": "500 0 310.5\n0 502 242.25\n0 0 1\n",
    "K.txt with commas": "500.0,0,310.5\n0,502.0,242.25\n0,0,1",
    "K in JSON": '{"K": [[500, 0, 310.5], [0, 502, 242.25], [0, 0, 1]]}',
    "COLMAP": "1 PINHOLE 640 480 500 502 311 242.75\n",
}


@pytest.mark.parametrize("name", SINGLE)
def test_one_camera_is_that_of_both_views(name: str, tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(SINGLE[name])
    found = Calibration.load(path, SIZE, SIZE)
    np.testing.assert_allclose(found.camera0.matrix, LEFT)
    assert found.camera0 == found.camera1
    assert found.baseline_mm is None


def test_kitti_has_two_pairs(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    views = {"P0": (LEFT, 0), "P1": (RIGHT, 537), "P2": (LEFT, -60), "P3": (RIGHT, 60)}
    text = "".join(f"{key}: {line(projection(*v, 1000))}\n" for key, v in views.items())
    path.write_text(text + "Tr: " + line(np.eye(3, 4)))
    check(Calibration.load(path, SIZE))
    check(Calibration.load(path, SIZE, views=(0, 1)), 537)
    with pytest.raises(ReconstructionError):
        Calibration.load(path, SIZE, views=(1, 0))


def test_cameras_of_pycolmap(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    for model, extra in (("SIMPLE_PINHOLE", []), ("SIMPLE_RADIAL", [0.0]), ("RADIAL", [0.0, 0.0])):
        own = pycolmap.Camera(
            model=model, width=640, height=480, params=[500, 311, 242.75, *extra], camera_id=1
        )
        made = pycolmap.Reconstruction()
        made.add_camera(own)
        made.write_text(str(tmp_path))
        found = Calibration.load(tmp_path / "cameras.txt")
        assert found.camera0.focal_px == (500, 500)
        assert found.camera0.centre == (310.5, 242.25)


@pytest.mark.parametrize(
    "text",
    [
        kalibr("-0.28, 0.07, 0.0, 0.0"),
        euroc(LEFT, 0, "-0.283, 0.0739, 0.0, 0.0"),
        "1 SIMPLE_RADIAL 640 480 500 320 240 -0.02\n",
        "1 OPENCV_FISHEYE 640 480 500 500 320 240 0 0 0 0\n",
        kalibr().replace("radtan", "equidistant"),
        COLMAP + "3 PINHOLE 640 480 1 1 1 1\n",
        "words, and no numbers",
        "a: [1, 2",
        "<a><b></a>",
        "1 2 3 4",
        MIDDLEBURY.replace("width=640", "width=320"),
    ],
)
def test_what_is_not_read_is_refused_with_its_file(text: str, tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(text)
    with pytest.raises(ReconstructionError, match=path.name):
        Calibration.load(path, SIZE, SIZE)
