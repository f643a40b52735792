"""ONNX files for other programs: any size or one, in three precisions."""

from __future__ import annotations

import importlib.util
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from ..._shared.atomic import atomic_path
from ..._shared.errors import (
    MissingExtraError,
    OptionError,
    WeightsError,
    install_command,
    unknown_name,
)
from ..._shared.options import check_ranges, suggest_keywords
from ...features.selection import check_max_keypoints
from ..pretrained import resolve_weights
from .onnx_graph import ANY_SIZE, check_graph, fix_size, read_metadata, write_metadata
from .onnx_keypoints import MAX_KEYPOINTS, add_keypoints, remove_keypoints
from .onnx_precision import to_float16, to_int8

if TYPE_CHECKING:
    from onnx import ModelProto

PRECISIONS = ("fp32", "fp16", "int8")


MAX_CALIBRATION_IMAGES = 32
"""At most this many images calibrate int8, evenly chosen."""


@suggest_keywords
@dataclass(frozen=True)
class OnnxOptions:
    """What an exported ONNX file is like.

    Attributes:
        size: height and width in pixels of a file that takes this size only, for OpenCV 4 and other
            runtimes without dynamic shapes. None: any height and width.
        batch: number of images that a file with a size takes; without a size it is free.
        precision: "fp32", "fp16" (half the bytes), or "int8" (quantised, for
            which it needs calibration images; it marks other pixels).
        max_keypoints: the file gives this many dense keypoints, too, the best ones: what
            `DeepDetect.detect` finds with the same `max_keypoints`, `nms_radius=1` and
            `subpixel=True`. 0: maps only; OpenCV 4 refuses files with keypoints.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    size: tuple[int, int] | None = None
    batch: int = 1
    precision: Literal["fp32", "fp16", "int8"] = "fp32"
    max_keypoints: int = MAX_KEYPOINTS

    def __post_init__(self) -> None:
        if self.precision not in PRECISIONS:
            raise unknown_name("precision", self.precision, PRECISIONS)
        if self.size is not None and len(self.size) != 2:
            raise OptionError(f"`size` must be height and width, not {self.size}")
        ranges = {"size": (8, 16384), "batch": (1, 1024), "max_keypoints": (0, 100_000)}
        check_ranges(self, between=ranges)
        if self.max_keypoints:
            check_max_keypoints(self.max_keypoints)
        if self.batch > 1 and self.size is None:
            raise OptionError("`batch` needs `size`: a file for any size takes any batch")

    @property
    def metadata(self) -> dict[str, str]:
        """What the file says of its options."""
        values = {**ANY_SIZE, "precision": self.precision}
        if self.size is not None:
            height, width = self.size
            values |= {"size": f"{height}x{width}", "batch": str(self.batch)}
        if self.max_keypoints:
            values["max_keypoints"] = str(self.max_keypoints)
        return values


def write_onnx(
    weights: str | Path,
    path: str | Path,
    options: OnnxOptions = OnnxOptions(),
    *,
    calibration: Sequence[Path] = (),
    licence: str | None = None,
) -> dict[str, str]:
    """Write weights as an ONNX file for other programs, whole or not at all.

    Args:
        weights: "default", "dense" or "free"; an ONNX file that this package has written in fp32
            for any size; or a safetensors file, which needs torch.
        path: the file to be written, ending in .onnx.
        options: its size and precision, and whether it gives keypoints.
        calibration: images for int8, like those that it will be used on.
        licence: what the file says of the licence of the weights. None: that of the given file.

    Returns:
        The metadata that the file holds.

    Raises:
        MissingExtraError: the package onnx, or torch for safetensors, is not installed.
        OptionError: calibration images are missing for int8, or given for another precision.
        WeightsError: the weights are missing, damaged, or no fp32 network for any size.
        ImageError: a calibration image cannot be read.
    """
    if Path(path).suffix.lower() != ".onnx":
        raise OptionError(f"the name of an ONNX file ends in .onnx, not {Path(path).name}")
    if (options.precision == "int8") != bool(calibration):
        raise OptionError(
            "int8 needs images to take the ranges of values from: give `calibration`"
            if not calibration
            else f"`calibration` is for int8, not {options.precision}: leave one of them out"
        )
    _need("onnx", "exporting to ONNX")
    model = _load(weights)
    values = options.metadata if licence is None else {**options.metadata, "licence": licence}
    if options.precision == "int8":
        model = to_int8(model, _images(calibration))
    if options.size is not None:
        fix_size(model, *options.size, options.batch)
    if options.precision == "fp16":
        to_float16(model)
    if options.max_keypoints:
        add_keypoints(model, options.max_keypoints)
    write_metadata(model, values)
    with atomic_path(path) as temporary:
        temporary.write_bytes(model.SerializeToString())
    return read_metadata(model)


def _load(weights: str | Path) -> ModelProto:
    """Return weights as a network in fp32 for any size."""
    import onnx

    path = resolve_weights(weights)
    if not path.is_file():
        raise WeightsError(f"there is no weights file {path}: check the path")
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        return _from_torch(path)
    if suffix != ".onnx":
        raise WeightsError(f"{path} is no weights file: it must end in .onnx or .safetensors")
    try:
        model = onnx.load_model_from_string(path.read_bytes())
    except Exception as error:  # protobuf's, which onnx hands on
        raise WeightsError(
            f"{path} is not an ONNX file that can be read ({error}): download it again"
        ) from None
    remove_keypoints(model)
    check_graph(model, str(path))
    found = read_metadata(model)
    if any(found.get(name, value) != value for name, value in ANY_SIZE.items()):
        raise WeightsError(
            f"{path} has the size {found.get('size')} and the precision {found.get('precision')}: "
            "give the file that it was made from"
        )
    if "weights" not in found:
        write_metadata(model, {"weights": path.name})
    return model


def _from_torch(path: Path) -> ModelProto:
    """Return a safetensors file as a network in fp32 for any size."""
    import onnx

    for package in ("torch", "safetensors"):
        _need(package, f"exporting {path.name}")
    from .onnx_export import export_onnx
    from .weights import load_network

    network = load_network(path)
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "network.onnx"
        export_onnx(network, made, {"weights": path.name})
        model = onnx.load_model(str(made))
    remove_keypoints(model)
    return model


def _images(paths: Sequence[Path]) -> Iterator[np.ndarray]:
    """Yield some of the images, evenly chosen, at the size that the network sees."""
    from ...io.image import load_image

    step = max(1, len(paths) / MAX_CALIBRATION_IMAGES)
    for k in range(min(len(paths), MAX_CALIBRATION_IMAGES)):
        yield load_image(paths[int(k * step)])


def _need(package: str, what: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise MissingExtraError(
            f"{what} needs the package {package}, which is not installed: "
            f"run {install_command(package)}"
        )
