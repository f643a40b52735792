from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect._shared.errors import ReconstructionError
from deepdetect.io.exif import calibration_from_exif, camera_from_exif
from deepdetect.io.image import load_image

FOCAL, FILM, PLANE_X, PLANE_Y, UNIT, WIDTH, HEIGHT = (
    *(0x920A, 0xA405, 0xA20E, 0xA20F, 0xA210),
    *(0xA002, 0xA003),
)


def photograph(
    tags: dict[int, object], orientation: int = 1, size: tuple[int, int] = (300, 200)
) -> bytes:
    image = Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update(tags)
    file = io.BytesIO()
    image.save(file, "JPEG", exif=exif)
    return file.getvalue()


def size_of(data: object) -> tuple[int, int]:
    height, width = load_image(data).shape[:2]
    return width, height


def test_the_equivalent_of_35_mm_film_is_by_the_diagonal() -> None:
    """At 3:2, the shape of the film, its width of 36 mm is the image's width."""
    data = photograph({FILM: 24})
    camera = camera_from_exif(data, size_of(data))
    assert camera.focal_px == pytest.approx((24 / 36 * 300,) * 2)
    assert camera.centre == (149.5, 99.5)


@pytest.mark.parametrize(
    ("unit", "resolution"), [(2, 2540.0), (3, 1000.0), (4, 100.0), (None, 2540.0)]
)
def test_the_sensors_resolution_is_read_in_its_unit(unit: int | None, resolution: float) -> None:
    tags = {FOCAL: 5.0, PLANE_X: resolution, PLANE_Y: resolution * 1.02}
    data = photograph(tags if unit is None else {**tags, UNIT: unit})
    assert camera_from_exif(data, (300, 200)).focal_px == pytest.approx((500, 510), rel=1e-4)


def test_a_smaller_copy_of_the_photograph_has_a_shorter_focal_length() -> None:
    tags = {FOCAL: 5.0, PLANE_X: 2540.0, WIDTH: 1200, HEIGHT: 800}
    data = photograph(tags)
    assert camera_from_exif(data, (300, 200)).focal_px == pytest.approx((125, 125), rel=1e-4)


def test_a_sensor_that_contradicts_the_film_is_not_believed() -> None:
    agree, contradict = (
        photograph({FILM: 60, FOCAL: 5.0, PLANE_X: resolution, PLANE_Y: resolution})
        for resolution in (2600.0, 25400.0)
    )
    assert camera_from_exif(agree, (300, 200)).focal_px[0] == pytest.approx(511.8, abs=0.1)
    assert camera_from_exif(contradict, (300, 200)).focal_px[0] == pytest.approx(500)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photograph_on_its_side_is_read_as_it_is_loaded(orientation: int) -> None:
    tags = {FOCAL: 5.0, PLANE_X: 2540.0, PLANE_Y: 2600.0, WIDTH: 300, HEIGHT: 200}
    data = photograph(tags, orientation)
    size = size_of(data)
    camera = camera_from_exif(data, size)
    assert camera.size == size
    upright = size == (300, 200)
    assert upright == (orientation < 5)
    expected = (500, 511.8) if upright else (511.8, 500)
    assert camera.focal_px == pytest.approx(expected, abs=0.1)


def test_a_pil_image_is_not_turned() -> None:
    data = photograph({FILM: 24, WIDTH: 300, HEIGHT: 200}, orientation=6)
    with Image.open(io.BytesIO(data)) as image:
        assert camera_from_exif(image, size_of(image)).focal_px == pytest.approx((200, 200))


def test_what_carries_no_focal_length_says_what_to_give(tmp_path: Path) -> None:
    path = tmp_path / "plain.png"
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(path)
    for image in (
        path,
        str(path),
        np.zeros((20, 30, 3), np.uint8),
        photograph({}),
        photograph({FILM: 0}),
        photograph({FOCAL: 5.0}),
        photograph({FOCAL: 5.0, PLANE_X: 0.0}),
        b"no image",
    ):
        with pytest.raises(ReconstructionError, match=r"`focal_px`.*`calibration`"):
            camera_from_exif(image, (300, 200))
    cropped = photograph({FILM: 24, WIDTH: 400, HEIGHT: 200})
    with pytest.raises(ReconstructionError, match="400x200"):
        camera_from_exif(cropped, (300, 200))


def test_both_photographs_give_a_calibration() -> None:
    wide, narrow = photograph({FILM: 24}), photograph({FILM: 48})
    found = calibration_from_exif(wide, narrow, (300, 200), (300, 200))
    assert found.camera1.focal_px[0] == pytest.approx(2 * found.camera0.focal_px[0])
    assert found.source == "EXIF"
    assert found.baseline_mm is None
