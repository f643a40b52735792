"""Files of cameras of SLAM programs, devices and photogrammetry; expected numbers are by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deepdetect._shared.errors import ReconstructionError
from deepdetect.geometry.camera import Calibration, Camera

SIZE = (640, 480)
FX, FY, CX, CY = 500.0, 502.0, 310.5, 242.25
CAMERA = Camera(SIZE, (FX, FY), (CX, CY))
RIGHT = Camera(SIZE, (FX, FY), (326.0, CY))
ROW = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
SIDES = {"width": 640, "height": 480}
ZEROS = {"k1": 0.0, "k2": 0, "p1": 0.0, "p2": -0.0, "k3": 1e-17}


def load(tmp_path: Path, content: Any, size: tuple[int, int] | None = SIZE) -> Calibration:
    path = tmp_path / "camera.txt"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return Calibration.load(path, size)


def flat(name: str, values: dict[str, Any]) -> str:
    return "".join(f"{name}.{key}: {value}\n" for key, value in values.items())


def section(name: str, cx: float, fx: float = FX, k1: float = 0) -> str:
    return f"[{name}]\nfx={fx}\nfy={FY}\ncx={cx}\ncy={CY}\nk1={k1}\nk2=0\n\n"


ORB_SLAM = "%YAML:1.0\n\n# Camera Parameters\n" + flat("Camera", {**ROW, **ZEROS, **SIDES})
ORB_SLAM_STEREO = (
    '%YAML:1.0\n---\nFile.version: "1.0"\nCamera.type: "PinHole"\n'
    + flat("Camera", {**SIDES, "fps": 20})
    + flat("Camera1", {**ROW, "k1": 0.0})
    + flat("Camera2", {**ROW, "cx": 326.0})
    + "Stereo.ThDepth: 60.0\nStereo.T_c1_c2: !!opencv-matrix\n  rows: 4\n  cols: 4\n  dt: f\n"
    "  data:[1.0, 0, 0, 0.12, 0, 1.0, 0, 0, 0, 0, 1.0, 0, 0, 0, 0, 1.0]\n"
)
STELLA = {**ROW, **ZEROS, "cols": 640, "rows": 480, "model": "perspective", "setup": "stereo"}
ZED = (
    "[STEREO]\nBaseline=120\nTY=0.01\nTZ=-0.02\nCV_HD=0.001\n\n"
    + section("LEFT_CAM_HD", 650, 700)
    + section("RIGHT_CAM_HD", 652, 700)
    + section("LEFT_CAM_VGA", CX)
    + section("RIGHT_CAM_VGA", 326.0)
)


def depthai(**more: Any) -> dict[str, Any]:
    def camera(cx: float, to: int, x_cm: float, **values: Any) -> dict[str, Any]:
        link = {"toCameraSocket": to, "translation": {"x": x_cm, "y": 0, "z": 0}}
        matrix = [[FX, 0, cx], [0, FY, CY], [0, 0, 1]]
        zeros = {"cameraType": 0, "distortionCoeff": [0.0] * 14}
        return {"intrinsicMatrix": matrix, "extrinsics": link, **zeros, **SIDES, **values}

    colour = camera(900.0, -1, 0.0, width=1920, height=1080)
    left, right = camera(CX, 2, -12.0, **more), camera(326.0, 0, 6.0)
    empty = {"intrinsicMatrix": [], "distortionCoeff": [], "width": 0, "height": 0}
    pairs = {"leftCameraSocket": 1, "rightCameraSocket": 2}
    return {
        "boardName": "OAK-D",
        "cameraData": [[0, colour], [1, left], [2, right], [3, empty]],
        "stereoRectificationData": pairs,
    }


STEREO = {
    "ORB-SLAM2": ORB_SLAM + "Camera.bf:\t60.0\nViewer.PointSize:2\n",  # 500 px * 0.12 m
    "ORB-SLAM3, rectified": 'File.version: "1.0"\nCamera.type: "Rectified"\n'
    + flat("Camera", SIDES)
    + flat("Camera1", ROW)
    + "Stereo.b: 0.12\n",
    "ORB-SLAM3": ORB_SLAM_STEREO,
    "stella_vslam": json.dumps({"Camera": {**STELLA, "focal_x_baseline": 60.0}}),
    "OpenVSLAM": flat("Camera", {**STELLA, "focal_x_baseline": 60.0}),
    "DepthAI": json.dumps(depthai()),
}


@pytest.mark.parametrize("name", STEREO)
def test_stereo_cameras_have_their_baseline_in_mm(name: str, tmp_path: Path) -> None:
    found = load(tmp_path, STEREO[name])
    two = name in ("ORB-SLAM3", "DepthAI")
    assert (found.camera0, found.camera1) == (CAMERA, RIGHT if two else CAMERA)
    assert found.baseline_mm == pytest.approx(120)


def test_depth_cameras_have_no_baseline_between_their_images(tmp_path: Path) -> None:
    for text in (
        ORB_SLAM + "Camera.bf: 40.0\nDepthMapFactor: 5000.0\n",
        json.dumps({"Camera": {**STELLA, "focal_x_baseline": 40.0, "depthmap_factor": 5000.0}}),
    ):
        found = load(tmp_path, text)
        assert (found.camera0, found.baseline_mm) == (CAMERA, None)


def test_the_section_of_zed_is_that_of_the_size(tmp_path: Path) -> None:
    found = load(tmp_path, ZED, (672, 376))
    assert found.camera0 == Camera((672, 376), (FX, FY), (CX, CY))
    assert found.camera1.centre == (326.0, CY)
    assert found.baseline_mm == 120
    assert load(tmp_path, ZED, (1280, 720)).camera0.centre == (650, CY)
    with pytest.raises(ReconstructionError, match="1280x720"):
        load(tmp_path, ZED, SIZE)


MATRIX = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
BY_COLUMNS = [FX, 0, 0, 0, FY, 0, CX, CY, 1]
REALSENSE = {**SIDES, "ppx": CX, "ppy": CY, "fx": FX, "fy": FY, "coeffs": [0, 0, 0, 0, 0]}
OPEN3D = {**SIDES, "intrinsic_matrix": BY_COLUMNS}
OPENMVG_DATA = {**SIDES, "focal_length": FX, "principal_point": [CX, CY], "disto_k3": [0.0, 0, 0]}


def openmvg(data: dict[str, Any], name: str = "pinhole_radial_k3") -> dict[str, Any]:
    wrapper = {"polymorphic_name": name, "ptr_wrapper": {"id": 2147483660, "data": data}}
    view = {"filename": "1.jpg", "width": 4000, "height": 3000, "id_view": 0}
    views = [{"key": 0, "value": {"ptr_wrapper": {"data": view}}}]
    intrinsics = [{"key": 0, "value": wrapper}, {"key": 1, "value": wrapper}]
    return {"sfm_data_version": "0.3", "root_path": "x", "views": views, "intrinsics": intrinsics}


def meshroom(version: list[str], **values: Any) -> dict[str, Any]:
    camera = {"intrinsicId": "1", "width": "640", "height": "480", "type": "radial3"}
    views = [{"viewId": "1", "width": "640", "height": "480", "metadata": {"FocalLength": "4"}}]
    zeros = {"distortionParams": ["0", "0", "0"], "locked": "0"}
    return {"version": version, "views": views, "intrinsics": [{**camera, **zeros, **values}]}


def metashape(calibration: str, kind: str = "frame") -> str:
    resolution = '<resolution width="640" height="480"/>'
    sensor = (
        f'{resolution}<calibration type="{kind}" class="initial">{resolution}<f>9</f></calibration>'
    )
    adjusted = (
        f'<calibration type="{kind}" class="adjusted">{resolution}{calibration}</calibration>'
    )
    return (
        '<?xml version="1.0"?>\n<document version="2.0.0"><chunk label="1"><sensors>'
        f'<sensor id="0" type="{kind}">{sensor}{adjusted}<data>uint8</data>'
        '</sensor></sensors><cameras><camera id="0"/></cameras></chunk></document>'
    )


ADJUSTED = "<f>502</f><cx>-9</cx><cy>2.75</cy><b1>-2</b1>"  # (640 - 1) / 2 - 9 = 310.5
OLD_PHOTOSCAN = (
    "<calibration><projection>frame</projection><width>640</width><height>480</height>"
    "<fx>500</fx><fy>502</fy><cx>311</cx><cy>242.75</cy><skew>0</skew><k1>0</k1></calibration>"
)
XML = (
    "<calibration><projection>frame</projection><width>640</width><height>480</height>"
    f"{ADJUSTED}<date>2024-01-01T10:00:00Z</date></calibration>"
)
# (640 - 1) / 2 - 9 = 310.5; fractions are of 640 pixels
OPENSFM = {"projection_type": "brown", **SIDES, "focal_x": FX / 640, "focal_y": FY / 640}
OPENSFM_CENTRE = {"c_x": -9 / 640, "c_y": 2.75 / 640, **ZEROS}
NERF = {"w": 640, "h": 480, "fl_x": FX, "fl_y": FY, "cx": 311.0, "cy": 242.75, "k1": 0.0}
FRAMES = [{"file_path": f"{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
MATLAB = {
    **{"RadialDistortion": [0, 0], "TangentialDistortion": [0, 0], "ImageSize": [480, 640]},
    "IntrinsicMatrix": [[FX, 0, 0], [0, FY, 0], [CX + 1, CY + 1, 1]],
}
VINS = """%YAML:1.0
---
model_type: PINHOLE
camera_name: camera
image_width: 640
image_height: 480
distortion_parameters:
   k1: 0.0
   k2: 0
   p1: 0
   p2: 0
projection_parameters:
   fx: 500
   fy: 502
   cx: 310.5
   cy: 242.25
"""

SINGLE: dict[str, Any] = {
    "ORB-SLAM": ORB_SLAM,
    "RealSense": {**REALSENSE, "model": "distortion.brown_conrady"},
    "Open3D": OPEN3D,
    "Open3D, rows": {**OPEN3D, "intrinsic_matrix": MATRIX},
    "Open3D, view": {"class_name": "PinholeCameraParameters", "intrinsic": OPEN3D},
    "Open3D, trajectory": {"parameters": [{"extrinsic": [1, 0], "intrinsic": OPEN3D}] * 3},
    "OpenSfM": {"v2 unknown": {**OPENSFM, **OPENSFM_CENTRE}},
    "OpenSfM, reconstruction": [{"cameras": {"a b": {**OPENSFM, **OPENSFM_CENTRE}}, "shots": {}}],
    "OpenMVG": openmvg({**OPENMVG_DATA, "focal_length": [FX, FY]}),
    "Meshroom 1.0": meshroom(
        ["1", "0", "0"], pxFocalLength=[FX, FY], principalPoint=["310.5", "242.25"]
    ),
    "Meshroom 1.2.2": meshroom(
        ["1", "2", "2"],  # 25 / 32 * 640 = 500, 500 / (500 / 502) = 502, 320 - 9.5 = 310.5
        **{"focalLength": "25", "sensorWidth": "32", "sensorHeight": "24"},
        **{"pixelRatio": str(500 / 502), "principalPoint": ["-9.5", "2.25"]},
    ),
    "Meshroom 1.2.6": meshroom(
        ["1", "2", "6"],
        **{"focalLength": "25", "sensorWidth": "32", "sensorHeight": "24"},
        **{"pixelRatio": str(502 / 500), "principalPoint": ["-9.5", "2.25"]},
    ),
    "Metashape": XML,
    "Metashape, cameras": metashape(ADJUSTED),
    "PhotoScan before 1.2": OLD_PHOTOSCAN,
    "nerfstudio": {"camera_model": "OPENCV", **NERF, "frames": FRAMES},
    "nerfstudio, frames": {"frames": [{**NERF, **frame} for frame in FRAMES]},
    "MATLAB": MATLAB,
    "VINS-Fusion": VINS,
    "OpenCV, K1": {"K1": MATRIX, "D1": [0, 0, 0, 0, 0]},
    "BOP": {**ROW, "depth_scale": 0.1, **SIDES},
    "Replica": {"camera": {**ROW, "w": 640, "h": 480, "scale": 6553.5}},
    "Basalt": {"value0": {"intrinsics": [{"camera_type": "pinhole", "intrinsics": ROW}] * 2}},
    "Kalibr in JSON": {"intrinsics": [FX, FY, CX, CY], "resolution": [640, 480]},
    "JSON": ROW,
    "JSON with text": {key: str(value) for key, value in ROW.items()},
    "YAML": "fx: 5e2\nfy: 502\ncx: 310.5\ncy: 242.25\ndist_coeffs: [0, 0, 0, 0, 0]\n",
    "TOML": "[camera]\nfx = 500\nfy = 502.0\ncx = 310.5\ncy = 242.25\nname = 'left'\n",
    "lines": "fx=500\nfy=502\ncx=310.5\ncy=242.25\n",
    "XML": "<camera><fx>500</fx><fy>502</fy><cx>310.5</cx><cy>242.25</cy></camera>",
    "names on one line": "fx=500, fy=502, cx=310.5, cy=242.25\n",
    "a line": "500 502 310.5 242.25\n",
    "a line with a comment": "# fx fy cx cy\n500, 502, 310.5, 242.25",
    "a line of TUM": "500 502 310.5 242.25 0 0 0 0\n",
    "a line of 9": "500 502 310.5 242.25 0 0 0 0 0",
    "4x4": "500 0 310.5 0\n0 502 242.25 0\n0 0 1 0\n0 0 0 1\n",
}


@pytest.mark.parametrize("name", SINGLE)
def test_one_camera_is_that_of_both_views(name: str, tmp_path: Path) -> None:
    found = load(tmp_path, SINGLE[name])
    for camera in (found.camera0, found.camera1):
        assert camera.size == SIZE
        np.testing.assert_allclose(camera.matrix, CAMERA.matrix, rtol=0, atol=1e-9)
    assert found.baseline_mm is None


def test_matlab_counts_pixels_from_1(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="MATLAB"):
        found = load(tmp_path, "500 0 0\n0 502 0\n311.5 243.25 1\n")
    assert found.camera0 == CAMERA


def test_a_principal_point_that_may_be_relative_to_the_middle_is_told(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="middle"):
        found = load(tmp_path, {**ROW, "cx": 12.5, "cy": 7.25})
    assert found.camera0.centre == (12.5, 7.25)


def test_a_principal_point_that_is_not_given_is_the_middle(tmp_path: Path) -> None:
    """A field of view of 90 degrees has the focal length 640 / 2 / tan(45 degrees) = 320."""
    bundler = "# Bundle file v0.3\n2 1\n" + "500 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n" * 2
    for content, focal in (
        ({"camera_angle_x": np.pi / 2, "frames": FRAMES}, 320),
        ({"camera_angle_x": np.pi / 2, "w": 640, "h": 480}, 320),
        (bundler + "0 0 1\n255 0 0\n1 0 0 9.5 -3\n", FX),
        ({"v2": {"projection_type": "perspective", "focal": FX / 640, **SIDES}}, FX),
        ({"v2": {"projection_type": "perspective", "focal": FX / 640}}, FX),
        (XML.replace("<cx>-9</cx><cy>2.75</cy><b1>-2</b1>", "").replace("502", "500"), FX),
    ):
        found = load(tmp_path, content)
        assert found.camera0.focal_px == pytest.approx((focal, focal))
        assert found.camera0.centre == (319.5, 239.5)


def test_transforms_that_this_package_writes_are_read_back(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap")
    from deepdetect.geometry.camera import PosedView
    from deepdetect.sfm.colmap import CameraIntrinsics
    from deepdetect.sfm.splat import write_transforms

    for k1 in (0.0, -0.05):
        model, params = ("PINHOLE", (FX, FY, CX + 0.5, CY + 0.5))
        if k1:
            model, params = "SIMPLE_RADIAL", (FX, CX + 0.5, CY + 0.5, k1)
        own = CameraIntrinsics(model, SIZE, params)
        view = PosedView("a.jpg", own.pinhole, np.eye(3), np.zeros(3))
        files = {"file_path": {"a.jpg": tmp_path / "a.jpg"}}
        path = tmp_path / "transforms.json"
        write_transforms(path, {"a.jpg": view}, {"a.jpg": own}, files, tmp_path / "points.ply")
        if k1:
            with pytest.raises(ReconstructionError, match="k1"):
                Calibration.load(path)
        else:
            assert Calibration.load(path).camera0 == own.pinhole


def test_cameras_of_other_sizes_do_not_count(tmp_path: Path) -> None:
    upright = {**NERF, "w": 480, "h": 640, "cx": 240.0, "cy": 320.0}
    values = {"frames": [{**camera, **FRAMES[0]} for camera in (NERF, upright, NERF)]}
    assert load(tmp_path, values).camera0 == CAMERA
    assert load(tmp_path, values, (480, 640)).camera0.centre == (239.5, 319.5)
    assert load(tmp_path, depthai(), (1920, 1080)).camera0.centre == (900, CY)
    with pytest.raises(ReconstructionError, match="2 different"):
        load(tmp_path, {"frames": [NERF, {**NERF, "fl_x": 501}]})
    with pytest.raises(ReconstructionError, match="3 different"):
        load(tmp_path, {key: {**ROW, "fx": 400 + len(key)} for key in ("a", "bb", "ccc")})
    named = load(tmp_path, {"camera_left": ROW, "camera_right": {**ROW, "cx": 326.0}})
    assert (named.camera0, named.camera1) == (CAMERA, RIGHT)


DISTORTED: dict[str, tuple[Any, str]] = {
    "ORB-SLAM": (ORB_SLAM.replace("k1: 0.0", "k1: -2.8e-1"), "ORB-SLAM"),
    "ORB-SLAM, second": (ORB_SLAM_STEREO + "Camera2.k2: 0.07\n", "ORB-SLAM"),
    "ORB-SLAM, fisheye": (ORB_SLAM_STEREO.replace("PinHole", "KannalaBrandt8"), "ORB-SLAM"),
    "stella_vslam": ({"Camera": {**STELLA, "k1": -0.1}}, "stella_vslam"),
    "stella_vslam, panorama": ({"Camera": {"model": "equirectangular", **SIDES}}, "stella_vslam"),
    "ZED": (ZED.replace("k1=0", "k1=-0.17"), "ZED"),
    "ZED X": (ZED + "[LEFT_DISTO]\nk1=-1.2\n[RIGHT_DISTO]\nk1=-1.2\n", "ZED"),
    "LSD-SLAM by OpenCV": ("500 502 310.5 242.25 -0.28 0 0 0\n640 480\ncrop\n640 480\n", "-0.28"),
    "RealSense": ({**REALSENSE, "coeffs": [-0.05, 0.06, 0, 0, 0]}, "RealSense"),
    "RealSense, fisheye": ({**REALSENSE, "model": "distortion.kannala_brandt4"}, "RealSense"),
    "DepthAI": (depthai(distortionCoeff=[0.1] * 14), "DepthAI"),
    "DepthAI, fisheye": (depthai(cameraType=1), "DepthAI"),
    "OpenSfM": ({"v2": {**OPENSFM, "k1": -0.02}}, "OpenSfM"),
    "OpenSfM, panorama": ({"v2": {"projection_type": "spherical", **SIDES}}, "OpenSfM"),
    "OpenMVG": (openmvg({**OPENMVG_DATA, "disto_k3": [-0.1, 0, 0]}), "OpenMVG"),
    "OpenMVG, fisheye": (openmvg({**OPENMVG_DATA, "fisheye": [0.0] * 4}), "OpenMVG"),
    "OpenMVG, panorama": (openmvg(dict(SIDES), "spherical"), "OpenMVG"),
    "Meshroom": (
        meshroom(["1"], pxFocalLength=FX, principalPoint=[CX, CY], distortionParams=["0.1"]),
        "Meshroom",
    ),
    "Meshroom, fisheye": (
        meshroom(["1"], pxFocalLength=FX, principalPoint=[CX, CY], type="fisheye4"),
        "Meshroom",
    ),
    "Metashape": (XML.replace("<date>", "<k1>-0.01</k1><date>"), "Metashape"),
    "Metashape, skew": (XML.replace("<date>", "<b2>0.3</b2><date>"), "Metashape"),
    "Metashape, cameras": (metashape(ADJUSTED + "<p1>0.001</p1>"), "Metashape"),
    "Metashape, fisheye": (metashape(ADJUSTED, "fisheye"), "Metashape"),
    "Bundler": ("# Bundle file v0.3\n1 0\n500 -0.1 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n", "Bundle"),
    "nerfstudio": ({**NERF, "k1": 0.02}, "transforms.json"),
    "nerfstudio, frame": ({**NERF, "frames": [{"p2": 0.02}]}, "transforms.json"),
    "nerfstudio, fisheye": ({**NERF, "camera_model": "OPENCV_FISHEYE"}, "transforms.json"),
    "instant-ngp, fisheye": ({**NERF, "is_fisheye": True}, "transforms.json"),
    "MATLAB": ({**MATLAB, "RadialDistortion": [0.1, 0]}, "MATLAB"),
    "VINS-Fusion": (VINS.replace("k1: 0.0", "k1: -0.3"), "k1|dist"),
    "Basalt": ({"value0": {"intrinsics": [{"camera_type": "ds", "intrinsics": ROW}]}}, "ds"),
    "JSON": ({**ROW, "k1": -0.1}, "k1"),
    "Basalt, Kannala-Brandt": (
        {"value0": {"intrinsics": [{"camera_type": "kb4", "intrinsics": {**ROW, **ZEROS}}]}},
        "kb4",
    ),
    "OpenVSLAM, panorama": (flat("Camera", {**SIDES, "model": "equirectangular"}), "equirect"),
    **{
        f"JSON, {name}": ({**ROW, name: [-0.28, 0.07]}, name)
        for name in ("k", "radial", "disto", "dist_params", "rad_dist", "kappa", "coef")
    },
    "JSON, beside": ({"camera": ROW, "distortion": {"k1": -0.1}}, "dist"),
    "a line of TUM": ("500 502 310.5 242.25 0.26 -0.95 -0.005 0.002 1.16", "0.26"),
    "a matrix with skew": ("500 3 310.5\n0 502 242.25\n0 0 1\n", "skew"),
}


@pytest.mark.parametrize("name", DISTORTED)
def test_distortion_is_refused_with_the_name_of_the_format(name: str, tmp_path: Path) -> None:
    content, named = DISTORTED[name]
    with pytest.raises(ReconstructionError, match=named):
        load(tmp_path, content)


REFUSED: dict[str, tuple[Any, str]] = {
    "a smaller copy": (
        {
            "distortion_model": "plumb_bob",
            "binning_x": 2,
            "P": [FX, 0, CX, 0, 0, FY, CY, *[0] * 3, 1, 0],
        },
        "binning_x",
    ),
    "a pose": ("0.36 0.48 -0.8\n-0.8 0.6 0\n0.48 0.64 0.6\n", "matrix"),
    "last row": ("500 0 310.5\n0 502 242.25\n0 0 2\n", "0 0 2"),
    "a homography": ('{"K": [[1, 0.1, 3], [0.2, 1, 5], [1e-4, 0, 1]]}', "matrix"),
    "a negative focal length": ("-500 0 310.5\n0 502 242.25\n0 0 1\n", "-500"),
    "a centre outside": ("500 0 1310.5\n0 502 242.25\n0 0 1\n", "1310.5"),
    "a centre outside, negative": ({**ROW, "cy": -40}, "-40"),
    "the identity": ("1 0 0\n0 1 0\n0 0 1\n", "focal"),
    "fractions of the image": ("0.78 1.04 0.5 0.5", "0.78|1.04"),
    "millimetres": ({**ROW, "fx": 4.2, "fy": 4.2}, "4.2"),
    "five of a matrix": ("500 0 310.5\n0 502", "0"),
    "no focal length": ({"cx": 320, "cy": 240}, "fx"),
    "no fy": ({"fx": 500, "cx": 320, "cy": 240}, "fy"),
    "no centre": ({"fx": 500, "fy": 500}, "cx"),
    "RealSense without fx": ({"ppx": 320, "ppy": 240}, "RealSense.*fx"),
    "Metashape without f": ("<calibration><width>9</width><height>9</height></calibration>", " f:"),
    "OpenSfM without focal": ({"v2": {"projection_type": "perspective", **SIDES}}, "focal"),
    "transforms without focal": ({"frames": FRAMES}, "fl_x"),
    "OpenMVG without cameras": ({**openmvg({}), "intrinsics": []}, "cameras"),
    "ORB-SLAM without fx": ("Camera.type: PinHole\nCamera.bf: 40.0\n", "ORB-SLAM.*fx"),
    "ZED without STEREO": (section("LEFT_CAM_VGA", CX) + section("RIGHT_CAM_VGA", CX), "STEREO"),
    "PhotoScan before 1.2 with skew": (OLD_PHOTOSCAN.replace("w>0", "w>2"), "Metashape.*skew"),
    "a chunk without cameras": ("<document><chunk><sensors/></chunk></document>", "Metashape"),
    "another size": ({**REALSENSE, "width": 1280, "height": 720}, "RealSense.*1280x720"),
    "an unknown key of a side": ({"focal_px": 500, "left": {"k1": -0.1}}, "k1"),
    "an unknown key": ({"focal_px": 500, "k1": -0.1}, "k1"),
    "a key with another name": ({"focal_px": 500, "baseline": 120}, "baseline_mm"),
    "a list at an unknown key": ({"focal_px": 500, "distortion": [0.1, 0]}, "distortion"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_wrong_is_said(name: str, tmp_path: Path) -> None:
    content, word = REFUSED[name]
    with pytest.raises(ReconstructionError, match=word) as error:
        load(tmp_path, content, (672, 376) if "ZED" in name else SIZE)
    assert 'no "focal_px"' not in str(error.value)


def test_no_refusal_where_the_number_is_zero(tmp_path: Path) -> None:
    values = {"focal_px": 500, "k1": 0, "p2": -0.0, "note": "left", "ground_truth": {"scale": 3.0}}
    assert load(tmp_path, values).camera0 == Camera(SIZE, 500)


@pytest.mark.filterwarnings("ignore:the principal point")
def test_any_3x3_matrix_is_a_camera_or_refused(tmp_path: Path) -> None:
    """Each of two hundred random matrices that is read is the camera's matrix itself."""
    generator = np.random.default_rng(5)
    read = 0
    for _ in range(200):
        matrix = generator.choice([0, 1, 300.0, -300.0], (3, 3), p=[0.5, 0.2, 0.25, 0.05])
        try:
            found = load(tmp_path, "\n".join(" ".join(map(str, row)) for row in matrix))
        except ReconstructionError:
            assert (
                not (np.tril(matrix, -1) == 0).all()
                or matrix[2, 2] != 1
                or matrix[0, 1] != 0
                or (np.diag(matrix)[:2] <= 64).any()
                or not (matrix[:2, 2] >= -1).all()
            )
        else:
            read += 1
            np.testing.assert_array_equal(found.camera0.matrix, matrix)
    assert read


OST = """# oST version 5.0 parameters

[image]

width
640

height
480

[narrow_stereo]

camera matrix
509 0 315.5
0 511 247.25
0 0 1

distortion
{} 0 0 0 0

projection
500 0 310.5 0
0 502 242.25 0
0 0 1 0
"""
RGBD = """Intrinsic of "Color" / 1280x720
  Width: \t1280
  Height: \t720
  PPX: \t640
  PPY: \t360
  Fx: \t900
  Fy: \t900
  Coeffs: \t0 0 0 0 0

Intrinsic of "Color" / 640x480
  Width: \t640
  Height: \t480
  PPX: \t310.5
  PPY: \t242.25
  Fx: \t500
  Fy: \t502
  Coeffs: \t0 0 0 0 0
"""
OTHERS: dict[str, Any] = {
    "ROS, ost.txt": OST.format(0),
    "RealSense, printed": RGBD,
    "numpy, printed": "K:\n [[500.   0. 310.5]\n [  0. 502. 242.25]\n [0. 0. 1.]]\nD: [0. 0.]\n",
    "MVSNet": "extrinsic\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n\n"
    "intrinsic\n500 0 310.5\n0 502 242.25\n0 0 1\n\n425 2.5\n",
    "DSO": "Pinhole 500 502 310.5 242.25 0\n640 480\nnone\n640 480\n",
    "LSD-SLAM by OpenCV": "500 502 310.5 242.25 0 0 0 0\n640 480\ncrop\n640 480\n",
    "LSD-SLAM, pinhole": "500 502 310.5 242.25 0\n640 480\nnone\n640 480\n",
    "DSO, fractions": f"RadTan {FX / 640} {FY / 480} {311 / 640} {242.75 / 480} 0 0 0 0\n"
    "640 480\ncrop\n640 480\n",
    "vikit": "cam_model: Pinhole\n"
    + "".join(f"cam_{key}: {ROW[key]}\n" for key in ROW)
    + "cam_d0: 0\n",
    "aslam": {"intrinsics": {"rows": 4, "cols": 1, "data": [*ROW.values()]}, "type": "pinhole"},
    "iOS, by columns": {"K": BY_COLUMNS, "w": 640, "h": 480},
    "4x4 in JSON": {"intrinsic": [[FX, 0, CX, 0], [0, FY, CY, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
    "mtx": {"mtx": MATRIX, "dist": [[0, 0, 0, 0, 0]]},
    "MATLAB, struct": {**MATLAB, "NumRadialDistortionCoefficients": 2, "EstimateSkew": False},
    "JSON with comments": '[{"fx": 500, "fy": 502, # px\n"cx": 310.5, "cy": 242.25,}]',
    "KITTI, one camera": "P_rect_02: 500 0 310.5 44.8 0 502 242.25 0.2 0 0 1 0.003\n",
    "ROS, whole": {"k": [*np.ravel(MATRIX)], "binning_x": 1, "roi": {"x_offset": 0, "width": 640}},
}


@pytest.mark.parametrize("name", OTHERS)
def test_files_of_other_programs(name: str, tmp_path: Path) -> None:
    found = load(tmp_path, OTHERS[name])
    for camera in (found.camera0, found.camera1):
        np.testing.assert_allclose(camera.matrix, CAMERA.matrix, rtol=0, atol=1e-9)
    assert found.baseline_mm is None


PAIR = {"left": ROW, "right": {**ROW, "cx": 326.0}}
MOVED = np.eye(4)
MOVED[0, 3] = 0.12
PAIRS: dict[str, Any] = {
    "baseline_mm": {**PAIR, "stereo": {"baseline_mm": 120}},
    "baseline_mm beside": {**PAIR, "baseline_mm": 120},
    "baseline in m": {**PAIR, "baseline_m": 0.12},
    "baseline_cm": {**PAIR, "baseline_cm": 12},
    "baseline under 1": {**PAIR, "baseline": 0.12},
    "baseline over 30": {**PAIR, "stereo_baseline": -120},
    "mtxL": {"mtxL": MATRIX, "mtxR": [[FX, 0, 326], *MATRIX[1:]], "T": [[-0.12], [0], [0]]},
    "OKVIS": {
        "cameras": [
            {"focal_length": [FX, FY], "principal_point": [cx, CY], "T_SC": list(pose.ravel())}
            for cx, pose in ((CX, np.eye(4)), (326.0, MOVED))
        ]
    },
    "MATLAB": {
        "CameraParameters1": MATLAB,
        "CameraParameters2": {
            **MATLAB,
            "IntrinsicMatrix": [[FX, 0, 0], [0, FY, 0], [327, CY + 1, 1]],
        },
        "TranslationOfCamera2": [-120, 0, 0],
    },
    "Kalibr, poses in a list": {
        f"cam{i}": {
            "camera_model": "pinhole",
            "intrinsics": [FX, FY, cx, CY],
            "T_cn_cnm1": [float(n) for n in MOVED.ravel()] if i else None,
        }
        for i, cx in enumerate((CX, 326.0))
    },
}


@pytest.mark.parametrize("name", PAIRS)
def test_a_baseline_has_the_unit_of_its_name_or_program(name: str, tmp_path: Path) -> None:
    found = load(tmp_path, PAIRS[name])
    assert (found.camera0, found.camera1) == (CAMERA, RIGHT)
    assert found.baseline_mm == pytest.approx(120)
    found.save(tmp_path / "calib.json")
    again = Calibration.load(tmp_path / "calib.json")
    assert (again.camera0, again.camera1, again.baseline_mm) == (CAMERA, RIGHT, found.baseline_mm)


def test_a_baseline_that_may_be_in_any_unit_is_told(tmp_path: Path) -> None:
    for values in ({**ROW, "baseline": 12}, {"M1": MATRIX, "M2": MATRIX, "T": [-3.3, 0, 0]}):
        with pytest.warns(UserWarning, match="baseline_mm"):
            found = load(tmp_path, values)
        assert (found.camera0, found.baseline_mm) == (CAMERA, None)


def test_distortion_beside_a_projection_matrix_is_told(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="distortion"):
        assert load(tmp_path, OST.format(-0.3)).camera0 == CAMERA


def test_cameras_of_kitti_that_are_missing_are_told(tmp_path: Path) -> None:
    row = "500 0 310.5 {} 0 502 242.25 0 0 0 1 0\n"
    path = tmp_path / "calib.txt"
    path.write_text("P2: " + row.format(0) + "P3: " + row.format(-60))
    with pytest.warns(UserWarning, match="0 and 1"):
        found = Calibration.load(path, SIZE, views=(0, 1))
    assert found.baseline_mm == pytest.approx(120)


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ({**ROW, "doffs": 15.5, "baseline": 120}, "15.5"),
        ({"k": [*np.ravel(MATRIX)], "binning_x": 2}, "binning"),
        ({"K": [*np.ravel(MATRIX)], "roi": {"x_offset": 16}}, "x_offset"),
        ({"K": {"rows": 3, "cols": 3, "dt": "d", "data": "$base64$OWQg"}}, "base64"),
        ("0.6 0.9 0.5 0.5 0.9\n640 480\ncrop\n640 480\n", "fov"),
        ("cam_model: ATAN\n" + "".join(f"cam_{k}: {v}\n" for k, v in ROW.items()), "ATAN"),
        ("721.5 721.5 0.0 609.6 172.9 0.537", "6 numbers"),
        ("A report\n\n  Name : project: one\n  f 35 mm\n", "cameras"),
        ("cam0:\n  camera_model: pinhole\n  distortion_coeffs: [0.1, 0]\n", "distortion"),
        (OST.format(-0.3).partition("projection")[0], "distortion"),
    ],
    ids=str,
)
def test_refusals_give_the_true_reason(content: Any, word: str, tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match=word) as error:
        load(tmp_path, content)
    assert "damaged" not in str(error.value)


def test_a_file_that_is_no_text_is_refused_as_such(tmp_path: Path) -> None:
    path = tmp_path / "camera.npz"
    np.savez(path, K=np.eye(3))
    with pytest.raises(ReconstructionError, match="text"):
        Calibration.load(path, SIZE)


def test_zeros_of_opencv_are_no_fisheye(tmp_path: Path) -> None:
    values = "<fisheye_model>0</fisheye_model><K><rows>3</rows><cols>3</cols><data>{}</data></K>"
    numbers = " ".join(map(str, np.ravel(MATRIX)))
    assert (
        load(tmp_path, f"<opencv_storage>{values.format(numbers)}</opencv_storage>").camera0
        == CAMERA
    )
