"""Image files: whole ones of all kinds, and damaged ones."""

from __future__ import annotations

import io
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image, features

from deepdetect import load_image

from ..case import Target, expect, prepared
from ..mutations import mutate

ORIENTATION = 0x0112
LOSSLESS = ("PNG", "TIFF", "BMP", "PPM", "GIF")
LOSSY = ("JPEG", "WEBP", "JPEG2000", "AVIF")


@prepared
def scene() -> np.ndarray:
    """Return a small picture with edges, (52, 60, 3) uint8."""
    noise = np.random.default_rng(0).integers(0, 256, (52, 60, 3)).astype(np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 3)
    smooth[10:30, 15:40] = (220, 40, 90)
    return smooth


def available(kind: str) -> bool:
    """Whether this Pillow writes a format."""
    needed = {"AVIF": "avif", "WEBP": "webp", "JPEG2000": "jpg_2000"}.get(kind)
    return needed is None or bool(features.check(needed))


def encode(image: Image.Image, kind: str, generator: np.random.Generator, **options: Any) -> bytes:
    """Return an image file, with one of the format's options."""
    file = io.BytesIO()
    if kind == "TIFF":
        options["compression"] = str(generator.choice(["raw", "tiff_lzw", "tiff_deflate"]))
    if kind in ("JPEG", "WEBP", "AVIF"):
        options["quality"] = 95
    image.save(file, kind, **options)
    return file.getvalue()


def damaged(kind: str, generator: np.random.Generator, folder: Path) -> None:
    """Read a damaged file, as a file or as bytes."""
    kind = kind if available(kind) else "PNG"
    modes = {"PNG": "RGB RGBA L P 1 I;16", "TIFF": "RGB L 1 I;16", "GIF": "P", "JPEG": "RGB L"}
    mode = str(generator.choice(modes.get(kind, "RGB").split()))
    image = Image.fromarray(scene())
    if mode == "I;16":
        image = Image.fromarray(scene()[:, :, 0].astype(np.uint16) * 257)
    else:
        image = image.convert(mode)
    content = encode(image, kind, generator)
    expected = load_image(content)
    changed = mutate(content, generator)
    fixed = kind == "PNG" and generator.random() < 0.3
    if fixed:
        changed = with_right_checksums(changed)
    found = read(changed, generator, folder, kind)
    expect(found.dtype == np.uint8 and found.ndim == 3 and found.shape[2] == 3, "no RGB image")
    expect(min(found.shape) >= 3 and min(found.shape[:2]) >= 16, f"of shape {found.shape}")
    if kind == "PNG" and not fixed:  # the other formats have no checksums
        same = found.shape == expected.shape and (found == expected).all()
        expect(same, "a damaged PNG file was read as whole")


def with_right_checksums(content: bytes) -> bytes:
    """Return a PNG file whose chunks have the checksums that their content asks for."""
    found, at = bytearray(content[:8]), 8
    while at + 12 <= len(content):
        length = int.from_bytes(content[at : at + 4], "big")
        body = content[at + 4 : at + 8 + length]
        found += content[at : at + 4] + body + zlib.crc32(body).to_bytes(4, "big")
        at += 12 + length
    return bytes(found)


def read(content: bytes, generator: np.random.Generator, folder: Path, kind: str) -> np.ndarray:
    """Give a file to the library by its path or as bytes."""
    if generator.random() < 0.5:
        return load_image(content)
    path = folder / f"photo.{kind.lower()}"
    path.write_bytes(content)
    return load_image(path if generator.random() < 0.5 else str(path))


def whole(generator: np.random.Generator, folder: Path) -> None:
    """Read a whole file of any format, mode and orientation."""
    kind = str(generator.choice([kind for kind in (*LOSSLESS, *LOSSY) if available(kind)]))
    pixels = scene()
    gray = kind in ("PNG", "TIFF", "JPEG", "PPM") and generator.random() < 0.4
    deep = gray and kind != "JPEG" and generator.random() < 0.5
    if gray:
        pixels = np.repeat(pixels[:, :, :1], 3, axis=2)
    stored = pixels[:, :, 0] if gray else pixels
    image = Image.fromarray(stored.astype(np.uint16) * 257 if deep else stored)
    options: dict[str, Any] = {}
    orientation = int(generator.integers(1, 9))
    if kind in ("JPEG", "PNG", "TIFF", "WEBP", "AVIF"):
        exif = Image.Exif()
        exif[ORIENTATION] = orientation
        options["exif"] = exif
    else:
        orientation = 1
    if kind == "GIF":
        image = image.convert("P", palette=Image.Palette.ADAPTIVE)
        pixels = np.asarray(image.convert("RGB"))
    if kind == "JPEG2000":
        options["irreversible"] = False
    if kind == "WEBP":
        options["lossless"] = True
    found = read(encode(image, kind, generator, **options), generator, folder, kind)
    expected = turned(pixels, orientation)
    expect(found.shape == expected.shape, f"{kind} orientation {orientation}: {found.shape}")
    far = np.abs(found.astype(int) - expected).mean()
    limit = 6 if kind in ("JPEG", "AVIF") else 0
    expect(far <= limit, f"{kind} orientation {orientation}: pixels are off by {far:.1f}")


def turned(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return stored pixels as EXIF says that they are to be shown."""
    flips = {
        1: pixels,
        2: pixels[:, ::-1],
        3: pixels[::-1, ::-1],
        4: pixels[::-1],
        5: pixels.swapaxes(0, 1),
        6: pixels.swapaxes(0, 1)[:, ::-1],
        7: pixels[::-1, ::-1].swapaxes(0, 1),
        8: pixels.swapaxes(0, 1)[::-1],
    }
    return flips[orientation]


def not_images(generator: np.random.Generator, folder: Path) -> None:
    """Read what is no image, under an image's name."""
    kinds = [
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 99 99\nshowpage\n",
        b"\x80\x04\x95\x0f\x00\x00\x00\x00\x00\x00\x00\x8c\x05posix\x94\x8c\x06system\x94\x93\x94.",
        b"<svg xmlns='http://www.w3.org/2000/svg'><rect width='9' height='9'/></svg>",
        b"PK\x03\x04" + bytes(60),
        b"%PDF-1.7\n1 0 obj\n<<>>\nendobj\n",
        b"\x00\x00\x00\x18ftypmp42" + bytes(64),
        bytes(200),
        b"",
    ]
    content = kinds[int(generator.integers(len(kinds)))] + generator.bytes(
        int(generator.integers(0, 80))
    )
    found = read(content, generator, folder, str(generator.choice(["jpg", "png", "tif"])))
    expect(False, f"no image was read as one of shape {found.shape}")


TARGETS = (
    Target("whole", "whole images of all formats, modes and orientations", whole, 1500),
    Target("not-images", "what is no image", not_images, 500),
    *(
        Target(f"{kind.lower()}", f"damaged {kind}", partial(damaged, kind), count)
        for kind, count in (
            *(("PNG", 2000), ("JPEG", 1500), ("TIFF", 1500)),
            *(("WEBP", 600), ("GIF", 600), ("BMP", 600), ("PPM", 600)),
            *(("JPEG2000", 600), ("AVIF", 400)),
        )
    ),
)
