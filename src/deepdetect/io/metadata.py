"""What an image file carries beside its pixels, and pictures that keep it.

Where it lies on the Earth (GeoTIFF 1.1, or a world file), its colour profile, and its EXIF.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL.ExifTags import IFD, Base

from .._shared.atomic import atomic_path
from .._shared.opencv import cv2
from .image_file import open_file, open_image
from .tiff import NO_DATA, ORIENTATION, TIFF_STARTS

PIXEL_SCALE, TIE_POINTS, TRANSFORMATION, KEY_DIRECTORY = 33550, 33922, 34264, 34735
KEYS = (KEY_DIRECTORY, 34736, 34737)
"""Tags of GeoTIFF: the directory of keys, their numbers and their texts."""

RASTER_TYPE_KEY, POINT = 1025, 2
"""Of the directory: whether whole coordinates are corners of pixels, or their centres."""

ICC_PROFILE = 34675
DOUBLE, ASCII = 12, 2
"""Types of TIFF."""

UPRIGHT = 1
"""Orientation of EXIF and TIFF."""


@dataclass(frozen=True, eq=False)
class Metadata:
    """What an image file carries beside its pixels.

    Attributes:
        to_world: (3, 3) from pixels, the centre of the first at (0, 0), to coordinates; or None.
        keys: tags that tell the coordinate system, as `tifffile` writes them.
        projection: content of the .prj file beside it, or None.
        no_data: number that stands for none, as GDAL's tag says, or None.
        profile: ICC profile, or None.
        exif: as Pillow's, or None.
        plain: whether its pixels are grey or RGB of 8 or 16 bits.
    """

    to_world: np.ndarray | None = None
    keys: tuple[tuple[Any, ...], ...] = ()
    projection: bytes | None = None
    no_data: float | None = None
    profile: bytes | None = None
    exif: Any = None
    plain: bool = True

    def moved(self, matrix: np.ndarray | None) -> Metadata:
        """Return that of the image whose pixels are these, moved by an affine (3, 3) matrix."""
        if self.to_world is None or matrix is None:
            return replace(self, to_world=None, keys=())
        return replace(self, to_world=self.to_world @ np.linalg.inv(matrix / matrix[2, 2]))

    def files_beside(self, path: Path) -> dict[Path, bytes]:
        """Return what is written beside a picture, which cannot tell it itself."""
        if self.to_world is None or (self.keys and path.suffix in (".tif", ".tiff")):
            return {}
        numbers = self.to_world[:2].T.ravel()
        world = {_world_file(path): "".join(f"{number:.17g}\n" for number in numbers).encode()}
        return world | ({path.with_suffix(".prj"): self.projection} if self.projection else {})

    def encode(self, rgb: np.ndarray, suffix: str, settings: list[int]) -> bytes:
        """Return a PNG or JPEG file of an (H, W, 3) RGB image."""
        parts = {cv2.IMAGE_METADATA_ICCP: self.profile}
        if self.exif:
            height, width = rgb.shape[:2]
            fine = self.exif.get_ifd(IFD.Exif)
            size = fine.get(Base.ExifImageWidth), fine.get(Base.ExifImageHeight)
            if size != (width, height):  # the equivalent is that of the whole frame
                fine.pop(Base.FocalLengthIn35mmFilm, None)
            fine |= {Base.ExifImageWidth: width, Base.ExifImageHeight: height}
            self.exif[Base.Orientation] = UPRIGHT
            parts[cv2.IMAGE_METADATA_EXIF] = self.exif.tobytes().removeprefix(b"Exif\0\0")
        kept = {kind: np.frombuffer(part, np.uint8) for kind, part in parts.items() if part}
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        _, data = cv2.imencodeWithMetadata(suffix, bgr, [*kept], [*kept.values()], settings)
        return data.tobytes()

    def write_tiff(self, bands: np.ndarray, path: Path) -> None:
        """Write an (H, W) or (H, W, C) image of any type as TIFF, whole or not at all."""
        from tifffile import imwrite

        tags = [*self.keys, *self._place()] if self.keys else []
        if self.no_data is not None:
            tags.append((NO_DATA, ASCII, 0, f"{self.no_data:.17g}", True))
        bands = bands[:, :, 0] if bands.shape[2:] == (1,) else bands
        colour = bands.shape[2:] == (3,) and bands.dtype in (np.uint8, np.uint16)
        with atomic_path(path) as temporary:
            imwrite(
                temporary,
                bands,
                photometric="rgb" if colour else "minisblack",
                planarconfig="contig" if bands.ndim == 3 else None,
                compression="zlib",
                iccprofile=self.profile,
                metadata=None,
                extratags=tags,
            )

    def _place(self) -> Iterator[tuple[Any, ...]]:
        assert self.to_world is not None
        matrix = self.to_world @ np.linalg.inv(_from_raster(self.keys))
        if matrix[0, 1] == matrix[1, 0] == 0:  # all programs read these
            scale = (matrix[0, 0], -matrix[1, 1], 0.0)
            yield PIXEL_SCALE, DOUBLE, 3, scale, True
            yield TIE_POINTS, DOUBLE, 6, (0.0, 0.0, 0.0, matrix[0, 2], matrix[1, 2], 0.0), True
        else:
            whole = np.eye(4)
            whole[np.ix_([0, 1], [0, 1, 3])] = matrix[:2]
            yield TRANSFORMATION, DOUBLE, 16, tuple(whole.ravel()), True


def read_metadata(source: Any) -> Metadata:
    """Read what an image file carries beside its pixels; nothing of what cannot be read."""
    found = Metadata()
    path = Path(source) if isinstance(source, (str, Path)) else None
    if path is not None and not path.is_file():  # a pipe is read once
        return found
    with open_file(source) as (file, _):
        if file.read(4) in TIFF_STARTS:
            found = _of_tiff(file)
    with suppress(Exception), open_image(source) as image:  # raw photographs and others have none
        found = replace(found, profile=found.profile or image.info.get("icc_profile"))
        exif = image.getexif()
        if image.format != "TIFF" and len(exif):
            found = replace(found, exif=exif)
        if exif.get(Base.Orientation, UPRIGHT) != UPRIGHT:  # the place is of it as it is stored
            return replace(found, to_world=None, keys=())
    if path is not None and found.to_world is None:
        with suppress(OSError, ValueError):
            numbers = np.array(_world_file(path, exists=True).read_text().split(), np.float64)
            found = replace(
                found, to_world=np.vstack([numbers.reshape(3, 2).T, [0, 0, 1]]), keys=()
            )
        with suppress(OSError):
            found = replace(found, projection=path.with_suffix(".prj").read_bytes())
    return found


def _of_tiff(file: Any) -> Metadata:
    from tifffile import TiffFile

    file.seek(0)
    with TiffFile(file, name="image.tif") as tiff:
        page = tiff.pages.first
        tags = {tag.code: (int(tag.dtype), tag.count, tag.value) for tag in page.tags}
        plain = page.samplesperpixel in (1, 3, 4) and str(page.dtype) in ("uint8", "uint16", "bool")
    own = KEYS if KEY_DIRECTORY in tags else ()
    keys = tuple((code, *tags[code], True) for code in own if code in tags)
    values = {code: np.array(tags[code][2]) for code in (PIXEL_SCALE, TIE_POINTS) if code in tags}
    matrix = None
    if TRANSFORMATION in tags:
        matrix = np.eye(3)
        matrix[:2] = np.reshape(tags[TRANSFORMATION][2], (4, 4))[np.ix_([0, 1], [0, 1, 3])]
    elif len(values) == 2:
        (x, y), (i, j, _, east, north, _) = values[PIXEL_SCALE][:2], values[TIE_POINTS][:6]
        matrix = np.array([[x, 0, east - i * x], [0, -y, north + j * y], [0, 0, 1]])
    if not keys or tags.get(ORIENTATION, (0, 0, UPRIGHT))[2] != UPRIGHT:
        matrix = None
    no_data = None
    with suppress(KeyError, ValueError):
        no_data = float(tags[NO_DATA][2])
    return Metadata(
        to_world=None if matrix is None else matrix @ _from_raster(keys),
        keys=() if matrix is None else keys,
        no_data=no_data,
        profile=bytes(tags[ICC_PROFILE][2]) if ICC_PROFILE in tags else None,
        plain=plain,
    )


def _from_raster(keys: tuple[tuple[Any, ...], ...]) -> np.ndarray:
    """Return the (3, 3) matrix from pixels to the raster coordinates of GeoTIFF."""
    directory = next(np.reshape(key[3], (-1, 4)) for key in keys if key[0] == KEY_DIRECTORY)
    point = any(row[0] == RASTER_TYPE_KEY and row[3] == POINT for row in directory[1:])
    shift = 0.0 if point else 0.5
    return np.array([[1, 0, shift], [0, 1, shift], [0, 0, 1]])


def _world_file(path: Path, exists: bool = False) -> Path:
    """Return the world file beside an image, as .pgw beside .png."""
    end = path.suffix[1:]
    endings = [f".{end[0]}{end[-1]}w", f".{end}w", ".wld"] if end else [".wld"]
    paths = [path.with_suffix(each) for ending in endings for each in (ending, ending.upper())]
    return next((each for each in paths if each.is_file()), paths[0]) if exists else paths[0]
