from __future__ import annotations

import csv
import hashlib
import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from deepdetect import DeepDetectError
from deepdetect_lab.datasets import remote_datasets
from deepdetect_lab.datasets.photographs import (
    CROP_SIDE_PX,
    Crop,
    cut,
    listed_crops,
    listed_sources,
    write_crops,
)


def smooth_picture(width: int, height: int) -> Image.Image:
    """A picture whose pixels say where they are."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    red, green = 255 * x / (width - 1), 255 * y / (height - 1)
    rgb = np.stack([red, green, np.full_like(red, 90)], axis=2)
    return Image.fromarray(rgb.round().astype(np.uint8))


def png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, "png")
    return buffer.getvalue()


@pytest.fixture
def unpacked(tmp_path: Path) -> tuple[Path, list[Crop]]:
    """Two repositories with a picture each, and three crops of them."""
    contents = {"gb82": png(smooth_picture(1000, 500)), "osie": png(smooth_picture(600, 900))}
    paths = {"gb82": "png/a b.png", "osie": "data/stimuli/1.png"}
    for source, content in contents.items():
        file = tmp_path / "sources" / source / paths[source]
        file.parent.mkdir(parents=True)
        file.write_bytes(content)
    crops = [
        Crop(source, paths[source], hashlib.sha256(contents[source]).hexdigest(), licence, *place)
        for source, licence, place in (
            ("gb82", "CC0", (480, 240, 0)),
            ("gb82", "CC0", (960, 100, 300)),
            ("osie", "MIT (repository)", (480, 0, 100)),
        )
    ]
    return tmp_path, crops


def test_there_are_8000_photographs_and_more() -> None:
    crops = listed_crops()
    pictures = {crop.sha256: (crop.source, crop.path) for crop in crops}
    assert len(pictures) >= 8000
    assert len({(crop.source, crop.path) for crop in crops}) == len(pictures)
    free = [crop for crop in crops if crop.is_free]
    assert {crop.source for crop in crops} == set(listed_sources())
    for name, part in (("photographs", crops), ("photographs-free", free)):
        dataset = remote_datasets()[name]
        assert dataset.images == len(part)
        assert len(dataset.files) == len({crop.source for crop in part})


def test_crops_replace_the_repositories(unpacked: tuple[Path, list[Crop]]) -> None:
    folder, crops = unpacked
    write_crops(folder, True, crops)
    assert not (folder / "sources").exists()
    with (folder / "licences.csv").open() as file:
        head, *rows = csv.reader(file)
    assert head == ["file", "picture", "licence", "sha256"]
    assert [row[0] for row in rows] == [
        f"{crop.part}/{crop.source}_{number:05d}.jpg" for number, crop in enumerate(crops)
    ]
    assert rows[0][1].startswith("https://github.com/gianni-rosato/gb82-image-set/blob/502f9f94")
    assert rows[2][2:] == ["MIT (repository)", crops[2].sha256]
    for row in rows:
        with Image.open(folder / row[0]) as image:
            assert image.size == (CROP_SIDE_PX, CROP_SIDE_PX)


@pytest.mark.parametrize("place", [(480, 240, 0), (960, 1440, 480), (700, 33, 7)])
def test_a_cut_is_that_of_the_scaled_picture(place: tuple[int, int, int]) -> None:
    picture = smooth_picture(1000, 500)
    side, x, y = place
    scaled = picture.resize((2 * side, side), Image.Resampling.LANCZOS)
    expected = scaled.crop((x, y, x + CROP_SIDE_PX, y + CROP_SIDE_PX))
    difference = np.asarray(cut(picture, *place)).astype(int) - np.asarray(expected)
    assert np.abs(difference).max() <= 2


def test_what_is_not_listed_is_refused(unpacked: tuple[Path, list[Crop]]) -> None:
    folder, crops = unpacked
    file = folder / "sources" / "osie" / crops[2].path
    file.write_bytes(file.read_bytes() + b"more")
    with pytest.raises(DeepDetectError):
        write_crops(folder, True, crops)
    file.unlink()
    with pytest.raises(DeepDetectError, match=r"data/stimuli/1\.png"):
        write_crops(folder, True, crops)


@pytest.mark.parametrize(
    ("licence", "free"),
    [
        ("CC BY 4.0", True),
        ("CC BY-SA 3.0", True),
        ("CC BY-NC 4.0", False),
        ("CC BY-NC-SA", False),
        ("CC BY-ND 2.0", False),
        ("CC BY, non-commercial use", False),
    ],
)
def test_what_only_begins_as_a_free_licence_is_not_free(licence: str, free: bool) -> None:
    assert Crop("gb82", "a.png", "0" * 64, licence, 480, 0, 0).is_free is free
