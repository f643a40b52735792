"""Export of ONNX files for other programs, for any image size or a fixed one.

The input of a file is `image`. Its outputs are the network's maps, `probability` and `logits`, and
the keypoints that `add_points` adds. Either the maps or the keypoints may be left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..._shared.atomic import atomic_path
from ..._shared.errors import OptionError, WeightsError, require_packages
from ..._shared.options import check_ranges, names_a_file, suggest_keywords
from ...features.learned import LEARNED, LEARNED_FREE
from ...features.selection import check_max_keypoints
from ..points.descriptor import descriptor_type
from ..pretrained import LOGITS, resolve_weights
from .graph import IMAGE, PROBABILITY, fix_size, read_metadata, replace_nodes, write_metadata
from .points import add_points, remove_points

if TYPE_CHECKING:
    from onnx import ModelProto

ANY_SIZE = {"size": "any", "batch": "any"}


@suggest_keywords
@dataclass(frozen=True)
class OnnxOptions:
    """Options of an exported ONNX file.

    Attributes:
        size: (height, width) in pixels, if the file is to accept images of this size only. OpenCV 4
            and other runtimes without dynamic shapes need it. None: images of any size.
        batch: number of images per run, if `size` is set. A file for any size takes any number.
        maps: include the outputs `probability` and `logits`, the network's maps of all pixels.
        max_keypoints: also output this many keypoints of all scales, as `PointDetector` finds them.
            0: none. OpenCV needs 0, because it rejects files with keypoints.
        descriptor: also output descriptors of the keypoints: "learned", "learned-free", or an ONNX
            file that `deepdetect train-descriptor` wrote. None: no descriptors.

    Raises:
        OptionError: a value is unknown or out of its range.
    """

    size: tuple[int, int] | None = None
    batch: int = 1
    maps: bool = True
    max_keypoints: int = 2048
    descriptor: str | Path | None = None

    def __post_init__(self) -> None:
        if self.size is not None and len(self.size) != 2:
            raise OptionError(f"`size` must be (height, width), not {self.size}")
        ranges = {"size": (8, 16384), "batch": (1, 1024), "max_keypoints": (0, 100_000)}
        check_ranges(self, counts=("size", "batch"), between=ranges)
        if self.max_keypoints or not self.maps:
            check_max_keypoints(self.max_keypoints)
        if self.descriptor is not None:
            if not self.max_keypoints:
                raise OptionError("`descriptor` needs `max_keypoints` above 0")
            if self.descriptor not in (LEARNED, LEARNED_FREE) and not names_a_file(self.descriptor):
                raise OptionError(
                    f"`descriptor` is {LEARNED!r}, {LEARNED_FREE!r} or a file, not "
                    f"{self.descriptor!r}"
                )
        if self.batch > 1 and self.size is None:
            raise OptionError(
                "`batch` needs `size`: a file for any size takes any number of images"
            )

    @property
    def metadata(self) -> dict[str, str]:
        """The entries of the file's metadata that state these options."""
        values = dict(ANY_SIZE)
        if self.size is not None:
            height, width = self.size
            values |= {"size": f"{height}x{width}", "batch": str(self.batch)}
        if self.max_keypoints:
            values["max_keypoints"] = str(self.max_keypoints)
        if self.descriptor:
            values["descriptor"] = descriptor_type(self.descriptor)
        return values


def write_onnx(
    weights: str | Path,
    path: str | Path,
    options: OnnxOptions = OnnxOptions(),
    *,
    licence: str | None = None,
) -> dict[str, str]:
    """Write weights as an ONNX file for other programs, atomically; return the file's metadata.

    `weights` are given by the name of bundled weights, or as an ONNX file of this package for any
    image size. If `licence` is None, the metadata keep the licence of the weights.
    """
    if Path(path).suffix.lower() != ".onnx":
        raise OptionError(f"the name of an ONNX file ends in .onnx, not {Path(path).name}")
    require_packages("exporting to ONNX", "onnx")
    model, origin = _load(resolve_weights(weights))
    if licence is not None:
        origin["licence"] = licence
    return write_model(model, path, options, origin)


def write_model(
    model: ModelProto, path: str | Path, options: OnnxOptions, origin: Mapping[str, str]
) -> dict[str, str]:
    """Adapt a network that takes any image size to `options`, and write it; return the metadata.

    `origin` tells where the weights come from, and becomes part of the metadata.
    """
    if options.size is not None:
        fix_size(model, *options.size, options.batch)
    if not options.maps:
        replace_nodes(model.graph, [])
        del model.graph.output[:]
    if options.max_keypoints:
        add_points(model, options.max_keypoints, options.descriptor)
    write_metadata(model, {**options.metadata, **origin})
    with atomic_path(path) as temporary:
        temporary.write_bytes(model.SerializeToString())
    return read_metadata(model)


def _load(path: Path) -> tuple[ModelProto, dict[str, str]]:
    """Load weights as a network for any image size; also return metadata on their origin."""
    import onnx

    try:
        model = onnx.load_model_from_string(path.read_bytes())
    except Exception as error:  # onnx passes on the errors of Protobuf
        raise WeightsError(
            f"{path} is not an ONNX file that can be read ({error}): download it again"
        ) from None
    remove_points(model)
    tensors = [value.name for value in (*model.graph.input, *model.graph.output)]
    if tensors != [IMAGE, PROBABILITY, LOGITS]:
        raise WeightsError(
            f"{path} is not a network of deepdetect (its inputs and outputs are "
            f"{', '.join(tensors)}): give a file that deepdetect has written"
        )
    found = read_metadata(model)
    if any(found.get(name, value) != value for name, value in ANY_SIZE.items()):
        raise WeightsError(
            f"{path} has the fixed size {found.get('size')}: give the file that it was made from"
        )
    kept = {name: value for name, value in found.items() if name in ("weights", "licence")}
    return model, {"weights": path.name, **kept}
