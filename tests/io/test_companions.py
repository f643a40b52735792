from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import ImageError
from deepdetect.io.image import find_images, name_images

GREYS = np.arange(600, dtype=np.uint8).reshape(20, 30)


def write(folder: Path, names: str, pixels: np.ndarray = GREYS) -> list[Path]:
    """Write an image with each of the names, of the format that its suffix tells."""
    paths = [folder / name for name in names.split()]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        kind = {".png": "PNG", ".tif": "TIFF", ".svs": "TIFF"}.get(path.suffix.lower(), "JPEG")
        Image.fromarray(pixels).save(path, kind)
    return paths


@pytest.mark.parametrize(
    ("photographs", "masks"),
    [
        ("a.jpg b.JPG", "a_mask.png b.mask.PNG"),
        ("a.jpg b.JPG", "a.jpg.png b.JPG.png"),
        ("a.jpg _b.jpg", "a-mask.png mask_a.png _b_Mask.png a.jpg.mask.png"),
        ("images/a.jpg images/b.jpg", "masks/a.png masks/b.jpg.png"),
        ("a.jpg s/b.jpg", "masks/a.png s/Mask/b_mask.png"),
        ("x/images/s/a.jpg", "x/image_masks/s/a.png"),
    ],
)
def test_masks_are_no_photographs(photographs: str, masks: str, tmp_path: Path) -> None:
    kept, left_out = write(tmp_path, photographs), write(tmp_path, masks)
    with pytest.warns(UserWarning, match=min(left_out).name):
        assert {*find_images(tmp_path)} == {*kept}
    with pytest.warns(UserWarning, match=left_out[0].name):
        assert [*name_images([*left_out, *kept]).values()] == kept


def test_what_is_named_as_a_mask_and_has_two_grey_levels_is_a_mask(tmp_path: Path) -> None:
    kept = write(tmp_path, "images/000.jpg images/left_image.png mask-shop.png masks.jpg")
    binary = np.eye(20, 30, dtype=np.uint8)
    masks = "images/mask.png images/dynamic_mask_000.png images/left_mask.png masks/0.png"
    left_out = write(tmp_path, masks, binary)
    with pytest.warns(UserWarning, match="4 masks"):
        assert {*find_images(tmp_path)} == {*kept}
    assert name_images(left_out[-1:])


@pytest.mark.parametrize(
    "names",
    [
        "a.jpg other_mask.png",
        "a.jpg a.png a.tif",
        "masks/a.png masks/b.png",
        "masks/x/a.jpg masks/x/a.png",
        "a.jpg a_masked.png unmask/a.png",
        "mask.png hat.png",
    ],
)
def test_what_is_the_mask_of_nothing_is_a_photograph(names: str, tmp_path: Path) -> None:
    paths = write(tmp_path, names)
    assert {*find_images(tmp_path)} == {*paths}


def test_images_of_any_suffix_are_read_or_named(tmp_path: Path) -> None:
    known = write(tmp_path, "1.MPO 2.jps 3.INSP 4.svs 5.TIF ortho.tif")
    write(tmp_path, "ortho.tif.ovr")  # GDAL's overviews
    (tmp_path / "calib.txt").write_text("P0: 7.1 0 0 0\n")  # begins nearly like a PGM file
    (tmp_path / "BMW.txt").write_text("BMW")
    np.savez(tmp_path / "points.npz", np.zeros(5))
    (tmp_path / "clip.mp4").write_bytes(b"\0\0\0\x18ftypmp42" + bytes(200))
    assert {*find_images(tmp_path)} == {*known}
    write(tmp_path, "clip.THM 6.jpg_original 7")
    with pytest.warns(UserWarning, match="3 .*original"):
        assert {*find_images(tmp_path)} == {*known}


def test_a_folder_of_only_unknown_suffixes_is_told(tmp_path: Path) -> None:
    write(tmp_path, "IMG_1 IMG_2")
    with pytest.warns(UserWarning, match="IMG_1"), pytest.raises(ImageError):
        find_images(tmp_path)
