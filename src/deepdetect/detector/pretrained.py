"""The bundled weights, and the names of tensors in ONNX files."""

from __future__ import annotations

from pathlib import Path

from .._shared.errors import MissingWeightsError
from .._shared.options import look_up, names_a_file

FOLDER = Path(__file__).parent / "weights"

RANKER = Path(__file__).parent / "points" / "ranker.npz"
"""The trained ranker of points; for its card see MODEL_CARD.md in the same folder."""

POINTS_GRAPH = RANKER.with_name("points.onnx")
"""ONNX graph of the whole detection of points, for export."""

PRETRAINED: dict[str, str] = {
    "default": "default",  # photographs in any light
    "dense": "dense",  # two views of a scene in normal light, denser
    "free": "free",  # like default, trained only on freely licensed photographs
    "espnet": "espnet",  # the paper's network, for photographs in any light
}
"""File names without suffix, by the names that users choose."""

STRIDE = 8
"""The network halves an image three times, so its sides must be multiples of 8."""

PADDED_IMAGE = "padded_image"
"""Name of the tensor that holds the image padded to multiples of 8, in files that pad it."""

LOGITS = "logits"
"""Name of the output that holds logits; an output of another name holds probabilities."""

POINTS = "keypoints", "scores", "sizes", "angles"
"""Names of further outputs of ONNX files with points. This package does not read these outputs."""


def pretrained_weights(name: str = "default") -> Path:
    """Return the path of bundled weights; an OptionError suggests the nearest known name."""
    return (FOLDER / look_up("name or file of weights", name, PRETRAINED)).with_suffix(".onnx")


def resolve_weights(weights: str | Path) -> Path:
    """Return the path of weights, given by a name in `PRETRAINED` or as a file."""
    path = Path(weights) if names_a_file(weights) else pretrained_weights(str(weights))
    if not path.is_file():
        raise MissingWeightsError(f"there is no weights file {path}: check the path")
    return path
