"""Extraction of the features of all images below a folder, into a file in hloc's layout.

hloc (https://github.com/cvg/Hierarchical-Localization) uses the pixel coordinates of DeepDetect.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from .._shared.errors import DeepDetectError, noted_failures
from .._shared.options import suggest_keywords
from .._shared.records import file_state, key
from .._shared.value_range import ValueRange
from ..detector.detector import DeepDetect, check_selection, find_keypoints
from ..detector.heatmap import HeatmapOptions, seen_size
from ..detector.point_detector import PointDetector
from ..features.keypoints import UNSET_ANGLE, Keypoints, unit_length
from ..features.selection import SelectionOptions
from ..features.sift import ROOT_SIFT, describe_keypoints
from ..io.image import find_images, load_visible, luma, one_range
from ..io.image_file import ReadingOptions, read_with, reading_options
from .hdf5 import SETTINGS, BatchReport, Group, Item, State, damaged, fill_file, open_hdf5

ROOT_SIFT_NORM = 512
"""Euclidean norm of RootSIFT descriptors that are stored as bytes."""


@suggest_keywords
def extract_features(
    folder: str | Path,
    path: str | Path,
    detector: DeepDetect | PointDetector | None = None,
    *,
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | Sequence[np.ndarray] = (),
    max_megapixels: float | None = None,
    engine: str = "processes",
    workers: int | None = None,
    overwrite: bool = False,
    quiet: bool = True,
) -> BatchReport:
    """Extract the features of all images below a folder into an HDF5 file in hloc's layout.

    Each image has a group, named by its path below the folder, such as "db/1.jpg". It contains:

    - `keypoints` (N, 2) float32: x right and y down in pixels, with the centre of the first pixel
      at (0, 0). Their attribute `uncertainty` is the uncertainty of a position in pixels.
    - `descriptors` (D, N) float32 of unit length: D is 64 for learned descriptors and 128 for
      RootSIFT, which the keypoints of a `DeepDetect` always get.
    - `scores` (N,) float32: higher is better.
    - `colors` (N, 3) uint8: sRGB colours at the keypoints.
    - `image_size` (2,) int32: width and height.
    - `scales` (N,) and `oris` (N,) float32, if the keypoints have sizes and angles: half the size
      (sigma) in pixels, and the angle in degrees.

    The same call continues an interrupted run. It skips unchanged images, adds new ones, and
    removes the groups of images that are missing or can no longer be read. A file is therefore for
    one folder only. The function starts processes, so a script must call it under
    `if __name__ == "__main__":`.

    Args:
        folder: folder of the images.
        path: the HDF5 file to write.
        detector: a `PointDetector`, which is the default, or a `DeepDetect` with `threads=1`,
            because every process has a detector of its own.
        selection: which pixels of a `DeepDetect` heat map become keypoints; None: those with a
            probability above 0.5.
        ignore: (H, W) mask, or one for each image size, true where keypoints are not wanted.
        max_megapixels: limit for an image, as in `load_image`; larger images count as failures.
        engine: "processes" for processes on this machine, or "ray" for a Ray cluster.
        workers: number of processes; default: one per processor.
        overwrite: replace an existing file instead of continuing it.
        quiet: show no progress bar.

    Returns:
        The number of keypoints of each image, and `failures`: images that could not be read, which
        do not stop the others.

    Raises:
        ImageError: the folder is missing, or holds no image.
        OptionError: an option is unknown, or the file was made with other settings.
        MissingExtraError: h5py, or what the engine needs, is not installed.
        DeepDetectError: the file cannot be written.

    Example:
        >>> if __name__ == "__main__":  # doctest: +SKIP
        ...     extract_features("images", "features.h5").check()
    """
    detector = PointDetector() if detector is None else detector
    check_selection(detector, selection)
    if selection is not None and selection.max_keypoints is None:
        selection = replace(selection, max_keypoints=detector.max_keypoints)
    root = Path(folder).absolute()
    names = [image.relative_to(root).as_posix() for image in find_images(root)]
    utf8 = [name for name in names if name == name.encode("utf-8", "ignore").decode()]
    known = None if overwrite else noted_range(path)
    limited = reading_options(max_megapixels=max_megapixels, deep_range=known)
    with read_with(limited), one_range([root / name for name in utf8]) as reading:
        pass
    settings = {
        **detector.settings,
        **reading.settings,
        **({} if selection is None else vars(selection)),
        "descriptor": getattr(detector, "descriptor_type", ROOT_SIFT),
        "version": __version__,
    }
    if len(masks := [ignore] if isinstance(ignore, np.ndarray) else [*ignore]):
        settings["ignore"] = key(masks)
    report = fill_file(
        path,
        settings,
        {name: {name: file_state(root / name)} for name in utf8},
        # Other processes do not inherit the reading options.
        partial(_extract, root, detector, selection, masks, reading),
        of="images",
        others_stay=lambda _: False,
        engine=engine,
        workers=workers,
        overwrite=overwrite,
        quiet=quiet,
    )
    unnamed = [f"{n}: its name is not UTF-8: rename it" for n in names if n not in utf8]
    return replace(report, failures=(*unnamed, *report.failures))


def noted_range(path: str | Path) -> ValueRange | None:
    """Return the value range in which the uint16 images of a features file were read, or None.

    Images that are added to the file later are read in the same range.
    """
    with suppress(DeepDetectError, ValueError, TypeError), open_hdf5(Path(path)) as file:
        low, high = json.loads(file.attrs[SETTINGS])["deep_range"]
        return low, high
    return None


def _extract(
    root: Path,
    detector: DeepDetect | PointDetector,
    selection: SelectionOptions | None,
    ignore: Sequence[np.ndarray],
    reading: ReadingOptions,
    images: Sequence[Item],
    counts: dict[str, int],
    failures: list[str],
) -> Iterator[Group]:
    for name, state in images:
        with noted_failures(name, failures):
            with read_with(reading):
                rgb, hidden = load_visible(root / name)
            gray = luma(rgb)
            for mask in (each for each in ignore if each.shape == gray.shape):
                hidden = mask if hidden is None else hidden | mask
            keypoints = find_keypoints(detector, rgb, selection, hidden)
            if isinstance(detector, PointDetector):
                keypoints = detector.describe(rgb, keypoints)
            else:
                keypoints = describe_keypoints(gray, keypoints)
            # A position is uncertain by one pixel of the scaled image in which it was found.
            seen = seen_size(gray.shape, HeatmapOptions(detector.settings["resolution"]))
            uncertainty = max(gray.shape[1] / seen[0], gray.shape[0] / seen[1])
            column, row = np.rint(keypoints.xy).astype(np.int64).T
            group = feature_group(name, keypoints, state, uncertainty)
            counts[name] = len(keypoints)
            yield replace(group, arrays={**group.arrays, "colors": rgb[row, column]})


def feature_group(
    name: str, keypoints: Keypoints, state: State = (), uncertainty: float = 1.0
) -> Group:
    """Return the group of an image's keypoints in hloc's layout; `uncertainty` is in pixels.

    Example:
        >>> keypoints = Keypoints([[3, 4]], [0.9], (8, 6), descriptors=np.full((1, 128), 45, "u1"))
        >>> group = feature_group("a.jpg", keypoints)
        >>> group.arrays["descriptors"].shape, (group.arrays["descriptors"] ** 2).sum().round(3)
        ((128, 1), np.float32(1.0))
    """
    arrays = {
        "keypoints": keypoints.xy,
        "scores": keypoints.scores,
        "image_size": np.array(keypoints.image_size, np.int32),
    }
    if keypoints.descriptors is not None:
        arrays["descriptors"] = np.ascontiguousarray(unit_length(keypoints.descriptors).T)
    if keypoints.sizes is not None and keypoints.angles is not None:
        arrays |= {"scales": keypoints.sizes / 2, "oris": keypoints.angles}
    return Group(name, arrays, state, {"keypoints": {"uncertainty": np.float32(uncertainty)}})


def read_keypoints(file: Any, name: str) -> Keypoints:
    """Return the keypoints of the image `name` in an HDF5 file.

    RootSIFT descriptors become bytes again. If another program wrote the file, the type of the
    descriptors is unknown. Raises an InvalidFileError for damaged keypoints.
    """
    try:
        settings = json.loads(file.attrs.get(SETTINGS, "{}"))
        return _keypoints_of(file[name], settings.get("descriptor"))
    except Exception as error:  # h5py and NumPy raise many types of errors for damaged files
        raise damaged(Path(f"{file.filename}, {name}"), error) from error


def _keypoints_of(group: Any, descriptor_type: str | None) -> Keypoints:
    arrays = {name: group[name][()] for name in group if name != "colors"}
    xy = np.asarray(arrays["keypoints"], np.float32)
    size, scales = arrays.get("image_size"), arrays.get("scales")
    if size is None:  # take the smallest image that contains the keypoints
        size = np.ceil(xy.max(axis=0, initial=0)) + 1
    angles = arrays.get("oris")
    if angles is not None:
        angles = np.asarray(angles, np.float32)
        angles = np.where(angles == UNSET_ANGLE, angles, angles % 360)
    descriptors = arrays.get("descriptors")
    if descriptors is not None:
        descriptors = np.ascontiguousarray(descriptors.T, np.float32)
        if not np.isfinite(descriptors).all():
            raise ValueError("its descriptors are not all finite numbers")
        if descriptor_type == ROOT_SIFT:
            descriptors = np.rint(descriptors * ROOT_SIFT_NORM).clip(0, 255).astype(np.uint8)
    return Keypoints(
        xy,
        arrays.get("scores", np.ones(len(xy), np.float32)),
        (int(size[0]), int(size[1])),
        sizes=None if scales is None else 2 * np.asarray(scales, np.float32),
        angles=angles,
        descriptors=descriptors,
        descriptor_type=descriptor_type,
    )
