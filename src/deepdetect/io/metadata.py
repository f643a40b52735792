"""What an image file carries beside its pixels, and pictures that keep it.

Where it lies on the Earth (GeoTIFF 1.1, or a world file), its colour profile, and its EXIF.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import IFD, Base

from .._shared.atomic import atomic_path
from .._shared.opencv import cv2
from .image_file import open_file, open_image, reading_options
from .tiff import NO_DATA, TIFF_STARTS, chosen_page, no_data_of

PIXEL_SCALE, TIE_POINTS, TRANSFORMATION, KEY_DIRECTORY = 33550, 33922, 34264, 34735
KEYS = (KEY_DIRECTORY, 34736, 34737)
"""Tags of GeoTIFF: the directory of keys, their numbers and their texts."""

RASTER_TYPE_KEY, POINT = 1025, 2
"""Of the directory: whether whole coordinates are corners of pixels, or their centres."""

ICC_PROFILE = 34675

EXIF_TEXTS = (
    Base.ImageDescription,
    Base.Make,
    Base.Model,
    Base.Software,
    Base.DateTime,
    Base.Artist,
    Base.Copyright,
)
EXIF_DIRECTORIES = (IFD.Exif, IFD.GPSInfo)
"""What EXIF says beside how pixels are stored."""


@dataclass(frozen=True, eq=False)
class Metadata:
    """What an image file carries beside its pixels.

    Attributes:
        to_world: (3, 3) from pixels, the centre of the first at (0, 0), to coordinates; or None.
        keys: tags that tell the coordinate system, as `tifffile` writes them.
        projection: content of the .prj file beside it, or None.
        no_data: number that stands for none, as GDAL's tag says, or None.
        profile, exif: ICC profile, and EXIF as Pillow's; or None.
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

    def write_beside(self, path: Path) -> None:
        """Write a world file, and a .prj file, beside a picture that cannot tell its place."""
        if self.to_world is None or (self.keys and path.suffix in (".tif", ".tiff")):
            return
        numbers = self.to_world[:2].T.ravel()
        world = "".join(f"{number:.17g}\n" for number in numbers).encode()
        beside = {_world_file(path): world, path.with_suffix(".prj"): self.projection}
        for place, content in beside.items():
            if content is not None:
                with atomic_path(place) as temporary:
                    temporary.write_bytes(content)

    def encode(self, rgb: np.ndarray, suffix: str, settings: list[int]) -> bytes:
        """Return a PNG or JPEG file of an (H, W, 3) RGB image."""
        parts = {cv2.IMAGE_METADATA_ICCP: self._profile_of(b"RGB ")}
        with suppress(struct.error):  # numbers that Pillow reads and cannot write
            if exif := self._exif_of(rgb):
                parts[cv2.IMAGE_METADATA_EXIF] = exif.tobytes().removeprefix(b"Exif\0\0")
        kept = {kind: np.frombuffer(part, np.uint8) for kind, part in parts.items() if part}
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        for count in range(len(kept), 0, -1):  # EXIF is left out first, if it is too large
            kinds, values = [*kept][:count], [*kept.values()][:count]
            done, data = cv2.imencodeWithMetadata(suffix, bgr, kinds, values, settings)
            if done:
                return bytes(data)
        return bytes(cv2.imencode(suffix, bgr, settings)[1])

    def _profile_of(self, space: bytes) -> bytes | None:
        """Return the ICC profile where it is whole, and of the colours that are written."""
        profile = self.profile or b""
        length = int.from_bytes(profile[:4], "big")
        return profile[:length] if length <= len(profile) and profile[16:20] == space else None

    def _exif_of(self, picture: np.ndarray) -> Any:
        """Return the EXIF of an upright picture of another size; or None."""
        if not self.exif:
            return None
        height, width = picture.shape[:2]
        fine = self.exif.get_ifd(IFD.Exif)
        size = fine.get(Base.ExifImageWidth), fine.get(Base.ExifImageHeight)
        if size != (width, height):  # the equivalent is that of the whole frame
            fine.pop(Base.FocalLengthIn35mmFilm, None)
        fine |= {Base.ExifImageWidth: width, Base.ExifImageHeight: height}
        self.exif[Base.Orientation] = 1
        for code in EXIF_TEXTS:  # of any encoding, which Pillow reads as Latin-1
            if not isinstance(text := self.exif.get(code, b""), bytes):
                self.exif[code] = str(text).encode("latin-1", "replace")
        return self.exif

    def write_tiff(self, bands: np.ndarray, path: Path) -> None:
        """Write an (H, W) or (H, W, C) image of any type as TIFF, whole or not at all."""
        from tifffile import imwrite

        tags = [*self.keys]
        if self.keys and self.to_world is not None:
            matrix = self.to_world @ np.linalg.inv(_from_raster(self.keys))
            if matrix[0, 1] == matrix[1, 0] == 0:  # all programs read these
                tie = (0.0, 0.0, 0.0, matrix[0, 2], matrix[1, 2], 0.0)
                tags.append((PIXEL_SCALE, "d", 3, (matrix[0, 0], -matrix[1, 1], 0.0), True))
                tags.append((TIE_POINTS, "d", 6, tie, True))
            else:
                whole = np.insert(np.insert(matrix, 2, 0.0, axis=0), 2, 0.0, axis=1)
                tags.append((TRANSFORMATION, "d", 16, tuple(whole.ravel()), True))
        if self.no_data is not None:
            tags.append((NO_DATA, "s", 0, f"{self.no_data:.17g}", True))
        exif = self._exif_of(bands)
        texts = {code: exif[code] for code in EXIF_TEXTS if code in exif} if exif else {}
        tags += [(code, "s", 0, text, True) for code, text in texts.items()]
        directories = {code: exif.get_ifd(code) for code in EXIF_DIRECTORIES} if exif else {}
        directories = {code: each for code, each in directories.items() if _can_be_written(each)}
        # Pointers, which tifffile does not write: they are made of the tags of the codes before.
        tags += [(code - 1, "I", 1, 0, True) for code in directories]
        bands = bands[:, :, 0] if bands.shape[2:] == (1,) else bands
        colour = bands.shape[2:] == (3,) and bands.dtype in (np.uint8, np.uint16)
        with atomic_path(path) as temporary:
            imwrite(
                temporary,
                bands,
                photometric="rgb" if colour else "minisblack",
                planarconfig="contig" if bands.ndim == 3 else None,
                compression="zlib",
                iccprofile=self._profile_of(b"RGB " if colour else b"GRAY"),
                metadata=None,
                software=False,
                extratags=tags,
            )
            for code, values in directories.items():
                _append_directory(temporary, code, values)


def _can_be_written(values: dict[int, Any]) -> bool:
    """Whether there are values of EXIF, and Pillow can write them: it reads larger numbers."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    directory = ImageFileDirectory_v2()
    directory.update(values)
    with suppress(struct.error):
        return bool(values and directory.tobytes())
    return False


def _append_directory(path: Path, code: int, values: dict[int, Any]) -> None:
    """Append a directory of EXIF to a TIFF file, whose tag `code - 1` becomes the pointer to it."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2
    from tifffile import TiffFile

    with TiffFile(path, mode="r+") as tiff:
        pointer, file = tiff.pages.first.tags[code - 1], tiff.filehandle
        directory = ImageFileDirectory_v2(prefix=b"II" if tiff.byteorder == "<" else b"MM")
        directory.update(values)
        place = file.seek(0, 2)
        place += place % 2
        file.seek(place)
        file.write(directory.tobytes(place))
        pointer.overwrite(place)
        file.seek(pointer.offset)
        file.write(struct.pack(tiff.byteorder + "H", code))


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
        kept = _kept_exif(exif) if image.format == "TIFF" else exif
        found = replace(found, exif=kept if len(kept) else None)
        if exif.get(Base.Orientation, 1) != 1:  # the place is of it as it is stored
            return replace(found, to_world=None, keys=())
    if path is not None and found.to_world is None:
        with suppress(OSError, ValueError):
            numbers = np.array(_world_file(path).read_text().split(), np.float64)
            found = replace(
                found, to_world=np.vstack([numbers.reshape(3, 2).T, [0, 0, 1]]), keys=()
            )
        with suppress(OSError):
            found = replace(found, projection=path.with_suffix(".prj").read_bytes())
    return found


def _kept_exif(exif: Any) -> Any:
    """Return what a TIFF file's tags say beside how its pixels are stored."""
    kept = Image.Exif()
    kept.update({code: exif[code] for code in EXIF_TEXTS if code in exif})
    for code in set(EXIF_DIRECTORIES).intersection(exif):
        kept.get_ifd(code).update(exif.get_ifd(code))
        kept[code] = 0  # a pointer, set when it is written
    return kept


def _of_tiff(file: Any) -> Metadata:
    from tifffile import TiffFile

    file.seek(0)
    with TiffFile(file, name="image.tif") as tiff:
        page = chosen_page([*tiff.pages], "the image", reading_options())
        tags = {tag.code: (int(tag.dtype), tag.count, tag.value) for tag in page.tags}
        plain = page.samplesperpixel in (1, 3, 4) and str(page.dtype) in ("uint8", "uint16", "bool")
    own = KEYS if KEY_DIRECTORY in tags else ()
    keys = tuple((code, *tags[code], True) for code in own if code in tags)
    values = {code: np.array(tags[code][2]) for code in (PIXEL_SCALE, TIE_POINTS) if code in tags}
    matrix = None
    if TRANSFORMATION in tags:
        matrix = np.reshape(tags[TRANSFORMATION][2], (4, 4))[np.ix_([0, 1, 3], [0, 1, 3])]
    elif len(values) == 2:
        (x, y), (i, j, _, east, north, _) = values[PIXEL_SCALE][:2], values[TIE_POINTS][:6]
        matrix = np.array([[x, 0, east - i * x], [0, -y, north + j * y], [0, 0, 1]])
    if not keys:
        matrix = None
    return Metadata(
        to_world=None if matrix is None else matrix @ _from_raster(keys),
        keys=() if matrix is None else keys,
        no_data=no_data_of(page),
        profile=bytes(tags[ICC_PROFILE][2]) if ICC_PROFILE in tags else None,
        plain=plain,
    )


def _from_raster(keys: tuple[tuple[Any, ...], ...]) -> np.ndarray:
    """Return the (3, 3) matrix from pixels to the raster coordinates of GeoTIFF."""
    directory = next(np.reshape(key[3], (-1, 4)) for key in keys if key[0] == KEY_DIRECTORY)
    point = any(row[0] == RASTER_TYPE_KEY and row[3] == POINT for row in directory[1:])
    shift = 0.0 if point else 0.5
    return np.array([[1, 0, shift], [0, 1, shift], [0, 0, 1]])


def _world_file(path: Path) -> Path:
    """Return the world file beside an image, as .pgw beside .png."""
    return path.with_suffix(f".{path.suffix[1:2]}{path.suffix[-1:]}w")
