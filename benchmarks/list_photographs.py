"""List the photographs of `deepdetect datasets get photographs`.

    python benchmarks/list_photographs.py CLONES OUTPUT.csv.gz --exclude data/oxford ...

CLONES holds a clone of each repository of `deepdetect.datasets.photographs.listed_sources`, as
OWNER+NAME, with the commit that is named there. What is damaged, too small, no photograph, or
nearly the same as an earlier picture is left out, and so is that of which the whole or the middle
is nearly the same as a picture below the folders of --exclude. Prints what is left of each source.
"""

from __future__ import annotations

import argparse
import collections
import csv
import gzip
import hashlib
import io
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from deepdetect import DeepDetectError
from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.progress import progress
from deepdetect.datasets.photographs import (
    CROP_SIDE_PX,
    PICTURE_SUFFIXES,
    RESTRICTED,
    Crop,
    Source,
    cut,
    listed_sources,
)
from deepdetect.io.image import find_images, load_image

MAX_ENLARGEMENT = 1.45
MANY_CROPS_SIDE_PX = 960
HASH_SIDE = 16
MAX_HASH_DISTANCE = 12
"""Of 256 bits, of two pictures that are nearly the same."""

MIN_COLOURS = 300
MIN_TEXTURE = 4.0
"""Mean step to the next pixel of a small copy, of 255: abstract art and gradients have less."""


def main() -> None:
    """Write the list."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("clones", type=Path)
    parser.add_argument("output", type=Path)
    parser.add_argument("--exclude", type=Path, nargs="*", default=[])
    arguments = parser.parse_args()
    excluded = [
        difference_hash(load_image(path))
        for folder in arguments.exclude
        for path in find_images(folder)
    ]
    print(f"{len(excluded)} pictures to keep out")
    hashes: list[np.ndarray] = []
    rows: list[Crop] = []
    for source in listed_sources():
        kept, reasons = list_source(source, arguments.clones, hashes, excluded)
        rows += kept
        pictures = len({crop.sha256 for crop in kept})
        print(f"{source.name}: {pictures} pictures, {len(kept)} crops; left out {dict(reasons)}")
    free = [crop for crop in rows if crop.is_free]
    pictures, free_pictures = (len({crop.sha256 for crop in some}) for some in (rows, free))
    print(f"{len(rows)} crops of {pictures} pictures, free {len(free)} of {free_pictures}")
    text = io.StringIO()
    csv.writer(text).writerows([*vars(crop).values()] for crop in rows)
    with atomic_path(arguments.output) as temporary:
        temporary.write_bytes(gzip.compress(text.getvalue().encode(), 9, mtime=0))


def list_source(
    source: Source, clones: Path, hashes: list[np.ndarray], excluded: list[np.ndarray]
) -> tuple[list[Crop], collections.Counter[str]]:
    """Return the crops of a repository, and how often what was left out for which reason.

    Hashes of what is kept are added.
    """
    clone = clones / source.repository.replace("/", "+")
    reasons: collections.Counter[str] = collections.Counter()
    kept: list[Crop] = []
    licences = file_licences(source, clone)
    paths = list_pictures(source, clone)
    with progress(len(paths), source.name, "picture", quiet=False) as bar:
        for path, content in read_files(clone, source.commit, paths):
            bar.update(1)
            reason = ""
            try:
                picture = Image.fromarray(load_image(content))
            except DeepDetectError:
                reason = "unreadable"
            else:
                reason = unfit(picture)
                found = difference_hash(np.asarray(picture))
                if not reason and is_near(found, hashes):
                    reason = "near another"
                if not reason:
                    middle = np.asarray(cut(picture, *places(picture.size)[0]))
                    if is_near(found, excluded) or is_near(difference_hash(middle), excluded):
                        reason = "excluded"
            if reason:
                reasons[reason] += 1
                continue
            hashes.append(found)
            digest = hashlib.sha256(content).hexdigest()
            licence = licences.get(Path(path).name) or licence_of(source, path)
            kept += [
                Crop(source.name, path, digest, licence, *place) for place in places(picture.size)
            ]
    return kept, reasons


def list_pictures(source: Source, clone: Path) -> list[str]:
    """List the pictures of a repository, in the folders that are wanted."""
    words = ("git", "-C", str(clone), "ls-tree", "-r", "-z", "--name-only", source.commit)
    names = subprocess.run(words, check=True, capture_output=True).stdout.decode().split("\0")
    return sorted(
        name
        for name in names
        if name.lower().endswith(PICTURE_SUFFIXES)
        and (not source.folders or name.startswith(tuple(f"{f}/" for f in source.folders)))
    )


def read_files(clone: Path, commit: str, paths: list[str]) -> Iterator[tuple[str, bytes]]:
    """Yield the contents of files of a commit; one that the clone lacks is left out."""
    words = ("git", "-C", str(clone), "cat-file", "--batch")
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        for path in paths:
            process.stdin.write(f"{commit}:{path}\n".encode())
            process.stdin.flush()
            head = process.stdout.readline().split()
            if head[-1] == b"missing":
                continue
            content = process.stdout.read(int(head[-1]))
            process.stdout.read(1)
            yield path, content
        process.stdin.close()


def licence_of(source: Source, path: str) -> str:
    """Return the licence of a file, as its folder or the repository states it."""
    for folder, licence in source.other_licences.items():
        if path.startswith(f"{folder}/"):
            return licence
    return source.licence


def file_licences(source: Source, clone: Path) -> dict[str, str]:
    """Return the licences of single files by name, where a repository lists them."""
    if source.name != "endless":
        return {}
    words = ("git", "-C", str(clone), "show", f"{source.commit}:{source.folders[0]}/LICENSE.tsv")
    text = subprocess.run(words, check=True, capture_output=True).stdout.decode()
    found = {}
    for line in text.splitlines()[1:]:
        name, licence = (line.split("\t") + [""])[:2]
        found[name] = plain_licence(licence)
    return found


def plain_licence(words: str) -> str:
    """Return the short name of a licence; as it is where it is not known to be free."""
    plain = words.lower()
    if RESTRICTED.search(plain):
        return words
    for mark, name in (
        ("cc0", "CC0"),
        ("by-sa", "CC BY-SA"),
        ("cc by", "CC BY"),
        ("unsplash", "Unsplash"),
    ):
        if mark in plain:
            return name
    return words or "none stated"


def unfit(picture: Image.Image) -> str:
    """Return why a picture is not fit to train on; "" where it is."""
    short, long = sorted(picture.size)
    if short * MAX_ENLARGEMENT < CROP_SIDE_PX:
        return "too small"
    if long > 4 * short:
        return "too narrow"
    small = np.asarray(picture.resize((128, 128), Image.Resampling.BOX)).astype(np.int64)
    if len(np.unique((small >> 3) @ (1 << 10, 1 << 5, 1))) < MIN_COLOURS and not is_gray(small):
        return "few colours"
    gray = small.mean(axis=2)
    texture = (np.abs(np.diff(gray, axis=0)).mean() + np.abs(np.diff(gray, axis=1)).mean()) / 2
    return "little texture" if texture < MIN_TEXTURE else ""


def is_gray(picture: np.ndarray) -> bool:
    """Whether a picture has no colours at all."""
    return bool((picture.max(axis=2) - picture.min(axis=2)).max() <= 2)


def difference_hash(rgb: np.ndarray) -> np.ndarray:
    """Return whether each of 16x16 pixels of a small copy is brighter than the next, packed."""
    size = (HASH_SIDE + 1, HASH_SIDE)
    gray = np.asarray(Image.fromarray(rgb).convert("L").resize(size, Image.Resampling.BOX))
    return np.packbits(gray[:, 1:] > gray[:, :-1])


def is_near(found: np.ndarray, hashes: list[np.ndarray]) -> bool:
    """Whether one of the hashes differs in few bits."""
    if not hashes:
        return False
    different = np.bitwise_count(np.bitwise_xor(np.stack(hashes), found)).sum(axis=1)
    return bool(different.min() <= MAX_HASH_DISTANCE)


def places(size: tuple[int, int]) -> list[tuple[int, int, int]]:
    """Return (short side, x, y) of the crops of a picture.

    One in its middle; of a large one two more, at twice the scale, from opposite corners.
    """
    short, long = sorted(size)
    scaled = max(CROP_SIDE_PX, round(long * CROP_SIDE_PX / short))
    middle = (scaled - CROP_SIDE_PX) // 2
    wide = size[0] >= size[1]
    found = [(CROP_SIDE_PX, middle if wide else 0, 0 if wide else middle)]
    if short >= MANY_CROPS_SIDE_PX:
        far = [
            max(0, round(side * MANY_CROPS_SIDE_PX / short) - CROP_SIDE_PX * 5 // 4)
            for side in size
        ]
        near = CROP_SIDE_PX // 4
        found += [(MANY_CROPS_SIDE_PX, near, near), (MANY_CROPS_SIDE_PX, far[0], far[1])]
    return found


if __name__ == "__main__":
    main()
