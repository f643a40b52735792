"""Writing images with the metadata of their source: georeference, ICC colour profile and EXIF.

The georeference is that of a GeoTIFF or a world file, read by rasterio.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.ExifTags import IFD, Base

from .._shared.atomic import atomic_path, write_whole
from .._shared.errors import DeepDetectError, OptionError, require_packages
from .._shared.image_array import to_8_bits
from .._shared.opencv import cv2
from .._shared.value_range import ValueRange
from .image import UPRIGHT
from .image_file import open_file, open_image, reading_options
from .tiff import NO_DATA, TIFF_STARTS, chosen_page, no_data_of

PIXEL_SCALE, TRANSFORMATION = 33550, 34264
"""Tags of GeoTIFF for pixel scale and transformation. A georeferenced TIFF has one of them."""

PLACES = re.compile(rb"<GeoTransform>|<GeodataXform|<GCPList|gml\.data|\xb1\x4b\xf8\xbd\x08\x3d")
MAX_HEADER_BYTES = 1 << 20
"""PLACES finds a georeference in the first MAX_HEADER_BYTES of .aux.xml and JPEG 2000 files."""

NO_MATRIX = "the place (georeference) of an image is not kept, since GDAL reads no affine matrix \
from it: warp an image with ground control points or RPCs by gdalwarp first"
NO_SYSTEM = "a GeoTIFF without a coordinate system is treated as a local grid: assign the system \
by gdal_edit.py -a_srs if you know it"

FIRST_CENTRE = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
"""This matrix maps the package's pixel coordinates, whose origin is the centre of the first pixel,
to GDAL's, whose origin is the top left corner of that pixel."""

ICC_PROFILE = 34675

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MAX_JPEG_SIDE_PX = 65_500
"""The largest width and height, in pixels, that libjpeg writes."""

JPEG_QUALITY = 85
"""Quality of JPEG files on libjpeg's scale of 0 to 100. Chosen by hand."""

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
"""EXIF tags and directories that are kept, since they do not depend on how pixels are stored."""

LAYOUT = re.compile(r"\s*[{<]|ImageJ=|SCANIMAGE|Aperio")
"""TIFF descriptions that begin like this (by tifffile, OME, ImageJ, ScanImage or Aperio) state the
layout of the pages of their file. They would be wrong for another image."""


@dataclass(frozen=True, eq=False)
class Metadata:
    """What an image file contains in addition to its pixels.

    Attributes:
        to_world: (3, 3) matrix from pixel coordinates, where (0, 0) is the centre of the first
            pixel, to world coordinates; None without a georeference.
        crs: coordinate reference system of the world as an object of rasterio; None: a local grid.
        no_data: value that means "no data" according to GDAL's tag, or None.
        profile: the ICC profile, or None.
        exif: the EXIF as an object of Pillow, or None.
        bands: number of bands, alpha included.
        dtype: NumPy data type of the values.
        mask: (H, W) bool, false where a GeoTIFF to be written has no data; None: it has all.
    """

    to_world: np.ndarray | None = None
    crs: Any = None
    no_data: float | None = None
    profile: bytes | None = None
    exif: Any = None
    bands: int = 3
    dtype: Any = np.uint8
    mask: np.ndarray | None = None

    @property
    def plain(self) -> bool:
        """Whether pixels are grey, RGB or RGB with alpha, of at most 16 bits per value."""
        return self.bands in (1, 3, 4) and np.dtype(self.dtype) in (np.uint8, np.uint16, np.bool_)

    def raster(self, rgb: np.ndarray, value_range: ValueRange) -> np.ndarray:
        """Convert uint16 RGB to the data type and values of this image, and to grey if it is grey.

        `value_range` are the values for which 0 and 65535 stand, unless this image is uint16.
        """
        if self.bands == 1 and (rgb == rgb[:, :, :1]).all():
            rgb = rgb[:, :, 0]
        if self.plain or rgb.dtype != np.uint16:
            return rgb
        numbers = value_range[0] + rgb * ((value_range[1] - value_range[0]) / 65535)
        return (numbers if self.dtype.kind == "f" else np.rint(numbers)).astype(self.dtype)

    def with_no_data(self, image: np.ndarray, absent: np.ndarray) -> tuple[np.ndarray, Metadata]:
        """Set absent pixels to the value that means "no data"; if there is none, mask them."""
        value, whole = self.no_data, np.iinfo(image.dtype) if image.dtype.kind in "iu" else None
        if value is None or not (whole is None or whole.min <= value <= whole.max):
            return image, replace(self, no_data=None, mask=~absent if absent.any() else None)
        filled = image.copy()
        filled[absent] = value
        return filled, self

    def moved(self, matrix: np.ndarray | None) -> Metadata:
        """Return the metadata after a warp by an affine (3, 3) matrix; None: no georeference."""
        if self.to_world is None or matrix is None:
            return replace(self, to_world=None, crs=None)
        return replace(self, to_world=self.to_world @ np.linalg.inv(matrix / matrix[2, 2]))

    def write_beside(self, path: Path) -> None:
        """Write a world file and a .prj file next to an image, unless it is a GeoTIFF."""
        if self.to_world is None or path.suffix.lower() in (".tif", ".tiff"):
            return
        numbers = self.to_world[:2].T.ravel()
        ending = _world_endings(path)[0]
        world = path.with_suffix(ending.upper() if path.suffix.isupper() else ending)
        texts = {world: "".join(f"{number:.17g}\n" for number in numbers)}
        with suppress(AttributeError, ValueError):  # no CRS, or one that WKT1 cannot state
            texts[path.with_suffix(".prj")] = self.crs.to_wkt(version="WKT1_ESRI")
        for place, text in texts.items():
            write_whole(place, text)

    def encode(self, rgb: np.ndarray, suffix: str, settings: list[int]) -> bytes:
        """Return a PNG or JPEG file of an (H, W, 3) RGB image."""
        parts = {cv2.IMAGE_METADATA_ICCP: self._profile_of(b"RGB ")}
        with suppress(struct.error):  # EXIF may have numbers that Pillow can read but not write
            if exif := self._exif_of(rgb):
                parts[cv2.IMAGE_METADATA_EXIF] = exif.tobytes().removeprefix(b"Exif\0\0")
        kept = {kind: np.frombuffer(part, np.uint8) for kind, part in parts.items() if part}
        bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
        # A part that is too large makes the encoder fail. EXIF is left out first, then also ICC.
        for count in range(len(kept), 0, -1):
            kinds, values = [*kept][:count], [*kept.values()][:count]
            done, data = cv2.imencodeWithMetadata(suffix, bgr, kinds, values, settings)
            if done:
                return bytes(data)
        return bytes(cv2.imencode(suffix, bgr, settings)[1])

    def _profile_of(self, space: bytes) -> bytes | None:
        """Return the ICC profile if it is complete and for the colour space `space`, or None."""
        profile = self.profile or b""
        length = int.from_bytes(profile[:4], "big")
        return profile[:length] if length <= len(profile) and profile[16:20] == space else None

    def _exif_of(self, picture: np.ndarray) -> Any:
        """Return the EXIF, changed to the size of `picture` and upright orientation, or None."""
        if not self.exif:
            return None
        height, width = picture.shape[:2]
        fine = self.exif.get_ifd(IFD.Exif)
        size = fine.get(Base.ExifImageWidth), fine.get(Base.ExifImageHeight)
        if size != (width, height):  # the deleted tag holds only for the whole photograph
            fine.pop(Base.FocalLengthIn35mmFilm, None)
        fine |= {Base.ExifImageWidth: width, Base.ExifImageHeight: height}
        self.exif[Base.Orientation] = 1
        for code in EXIF_TEXTS:  # Pillow reads texts of any encoding as Latin-1
            if not isinstance(text := self.exif.get(code, b""), bytes):
                self.exif[code] = str(text).encode("latin-1", "replace")
        return self.exif

    def write_tiff(self, bands: np.ndarray, path: Path) -> None:
        """Write an (H, W) or (H, W, C) image of any data type as TIFF atomically."""
        from tifffile import imwrite

        tags: list[tuple[Any, ...]] = []
        if self.no_data is not None:
            tags.append((NO_DATA, "s", 0, f"{self.no_data:.17g}", True))
        exif = self._exif_of(bands)
        texts = {code: exif[code] for code in EXIF_TEXTS if code in exif} if exif else {}
        tags += [(code, "s", 0, text, True) for code, text in texts.items()]
        directories = {code: exif.get_ifd(code) for code in EXIF_DIRECTORIES} if exif else {}
        directories = {code: each for code, each in directories.items() if _can_be_written(each)}
        # tifffile cannot write pointers to EXIF directories: `_append_directory` fills them in.
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
            if self.to_world is not None:
                with _rasterio() as rasterio, rasterio.open(temporary, "r+") as file:
                    corner = self.to_world @ np.linalg.inv(FIRST_CENTRE)
                    file.transform = rasterio.Affine(*corner[:2].ravel())
                    file.crs = self.crs or rasterio.CRS()
                    if self.mask is not None:
                        file.write_mask(self.mask)


def _can_be_written(values: dict[int, Any]) -> bool:
    """Return whether there are EXIF values, and Pillow can write all (some it can only read)."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    directory = ImageFileDirectory_v2()
    directory.update(values)
    with suppress(struct.error):
        return bool(values and directory.tobytes())
    return False


def _append_directory(path: Path, code: int, values: dict[int, Any]) -> None:
    """Append a directory of EXIF tags to a TIFF file.

    The file must have a placeholder, the tag `code - 1`. It becomes the tag `code`, which points to
    the directory.
    """
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


def read_metadata(source: Any, *, placed: bool = False) -> Metadata:
    """Read the metadata of an image file; what cannot be read counts as missing.

    The georeference is read if `placed` and the source is a path.

    Raises:
        MissingExtraError: the file has a georeference, and rasterio is not installed.
    """
    found, kind, page, orientation = Metadata(), "", None, 1
    path = Path(source) if isinstance(source, (str, Path)) else None
    if path is not None and not path.is_file():  # a pipe can be read only once
        return found
    with open_file(source) as (file, _):
        if file.read(4) in TIFF_STARTS:
            (found, page), kind = _of_tiff(file), "TIFF"
    with suppress(Exception), open_image(source) as image:  # raw photographs fail
        found = replace(found, profile=found.profile or image.info.get("icc_profile"))
        exif, kind = image.getexif(), image.format
        kept = _kept_exif(exif) if kind == "TIFF" else exif
        found = replace(found, exif=kept if len(kept) else None)
        orientation = exif.get(Base.Orientation, 1)
    if placed and path is not None and kind:
        found = replace(found, **_read_place(path, page, orientation))
    return found


def _read_place(path: Path, page: Any, orientation: int) -> dict[str, Any]:
    """Return `to_world` and `crs` of an image file, or of a page of a TIFF file, if known."""
    place: dict[str, Any] = {}
    files, stem = path.absolute().parent.glob("*"), path.stem.lower()
    beside = {each.suffix.lower(): each for each in files if each.stem.lower() == stem}
    tagged = page is not None and {PIXEL_SCALE, TRANSFORMATION} & {*page.tags.keys()}
    stated = bool(tagged or beside.keys() & {*_world_endings(path)})
    for each in (path, path.with_name(f"{path.name}.aux.xml")):
        with suppress(OSError), each.open("rb") as file:
            stated |= PLACES.search(file.read(MAX_HEADER_BYTES)) is not None
    if stated:
        require_packages(f"the georeference of {path}", "rasterio")
    name = str(path.absolute())  # GDAL may read `a:b` as DRIVER:FILE
    if page is not None and page.index:
        name = f"GTIFF_DIR:{page.index + 1}:{name}"
    # Files that GDAL cannot read have no georeference; a bad .prj file raises a ValueError.
    missing = OSError, ValueError, ImportError
    with suppress(*missing), _rasterio() as rasterio, rasterio.open(name) as file:
        if file.transform.is_identity:
            stated = stated or bool(file.gcps[0] or file.rpcs)
        else:
            upright = _stored_pixels(orientation, file.width, file.height)
            place["to_world"] = np.reshape(file.transform, (3, 3)) @ FIRST_CENTRE @ upright
            place["crs"] = file.crs
            if file.crs is None and ".prj" in beside:
                text = beside[".prj"].read_text("utf-8")
                place["crs"] = rasterio.CRS.from_user_input(text)
    crs = place.get("crs")
    if stated and "to_world" not in place:
        warnings.warn(NO_MATRIX, UserWarning, stacklevel=2)
    elif tagged and not (crs and (crs.is_geographic or crs.is_projected)):
        warnings.warn(NO_SYSTEM, UserWarning, stacklevel=2)
    return place


def _stored_pixels(orientation: int, width: int, height: int) -> np.ndarray:
    """Return the (3, 3) matrix from pixels of the upright image to those of the stored one."""
    stored = np.dstack(np.meshgrid([0.0, width - 1], [0.0, height - 1]))
    (first, right), (down, _) = UPRIGHT.get(orientation, np.asarray)(stored)
    axes = np.sign([right - first, down - first])
    return np.vstack([np.column_stack([*axes, first]), [0, 0, 1]])


@contextmanager
def _rasterio() -> Iterator[Any]:
    """Yield rasterio, which writes masks into the TIFF; a missing georeference gives no warning."""
    import rasterio

    with warnings.catch_warnings(), rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True):
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        yield rasterio


def _world_endings(path: Path) -> list[str]:
    """Return the possible suffixes of an image's world file in lower case, the usual one first."""
    ending = path.suffix[1:].lower()
    return [f".{ending[:1]}{ending[-1:]}w", f".{ending}w", ".wld"]


def _kept_exif(exif: Any) -> Any:
    """Return the EXIF tags of a TIFF file except those on how pixels are stored."""
    kept = Image.Exif()
    kept.update({code: exif[code] for code in EXIF_TEXTS if code in exif})
    if LAYOUT.match(str(kept.get(Base.ImageDescription, ""))):
        del kept[Base.ImageDescription]
    for code in set(EXIF_DIRECTORIES).intersection(exif):
        kept.get_ifd(code).update(exif.get_ifd(code))
        kept[code] = 0  # placeholder for the pointer, which is set when writing
    return kept


def _of_tiff(file: Any) -> tuple[Metadata, Any]:
    """Return a TIFF file's metadata except EXIF and georeference, and the page that is read."""
    from tifffile import TiffFile

    file.seek(0)
    with TiffFile(file, name="image.tif") as tiff:
        page = chosen_page([*tiff.pages], "the image", reading_options())
        profile = page.tags.valueof(ICC_PROFILE)
    profile = None if profile is None else bytes(profile)
    kind = {"bands": page.samplesperpixel, "dtype": page.dtype}
    return Metadata(no_data=no_data_of(page), profile=profile, **kind), page


def save_picture(
    rgb: np.ndarray,
    path: str | Path,
    metadata: Metadata = Metadata(),
    value_range: ValueRange = (0, 65535),
) -> None:
    """Write (H, W, 3) uint8 or uint16 RGB with its metadata as .png, .tif or .jpg, atomically.

    JPEG files have 8 bits: uint16 pixels are scaled so that `value_range` becomes black and white.
    """
    suffix = picture_suffix(path)
    if suffix.startswith(".tif"):
        metadata.write_tiff(rgb, Path(path))
        return
    # OpenCV would fail without giving a reason.
    if suffix != ".png" and max(rgb.shape[:2]) > MAX_JPEG_SIDE_PX:
        size = f"{rgb.shape[1]}x{rgb.shape[0]}"
        raise DeepDetectError(
            f"{path} cannot store an image of {size} pixels as JPEG: use a name that ends in .png"
        )
    settings = []
    if suffix != ".png":
        rgb, settings = to_8_bits(rgb, value_range), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    write_whole(path, metadata.encode(rgb, suffix, settings))


def picture_suffix(path: str | Path) -> str:
    """Return the lower-case suffix of an image file; one that cannot be written is an OptionError.

    Calling this before any expensive work lets a wrong suffix fail early.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in PICTURE_SUFFIXES:
        *names, last = PICTURE_SUFFIXES
        raise OptionError(f"{path} must end in {', '.join(names)} or {last}")
    return suffix
