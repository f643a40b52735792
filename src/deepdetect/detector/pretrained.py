"""The bundled weights, and the names of tensors in ONNX files."""

from __future__ import annotations

from pathlib import Path

from .._shared.errors import MissingWeightsError
from .._shared.options import look_up, names_a_file

FOLDER = Path(__file__).parent / "weights"

RANKER = Path(__file__).parent / "points" / "ranker.npz"
"""Weights of the network that ranks keypoints. MODEL_CARD.md in the same folder describes them."""

POINTS_GRAPH = RANKER.with_name("points.onnx")
"""ONNX graph of `PointDetector` without descriptors, which exported ONNX files can include."""

PRETRAINED: dict[str, str] = {
    "default": "default",  # photographs in any light
    "dense": "dense",  # two views of a scene in normal light; more keypoints
    "free": "free",  # like `default`, but trained only on freely licensed photographs
    "espnet": "espnet",  # the paper's network, for photographs in any light
}
"""Files of the bundled weights, without their suffix, by the names that users choose."""

STRIDE = 8
"""The network halves an image three times, so the image's sides must be multiples of 8."""

PADDED_IMAGE, PADDED_LOGITS = "padded_image", "padded_logits"
"""Tensors between which the network itself lies, in ONNX files that pad images to multiples of 8
and crop the logits."""

LOGITS = "logits"
"""Name of the ONNX output that holds logits; an output of another name holds probabilities."""

POINTS = "keypoints", "scores", "sizes", "angles"
"""Outputs of `POINTS_GRAPH`, and of exported files that include it."""

PREFIX = "points/"
"""The names of all other tensors in `POINTS_GRAPH`, except for its input, start with this."""

DESCRIPTORS, DESCRIBING = "descriptors", "descriptor/"
"""A further output of `POINTS_GRAPH`, and the start of the names of tensors between it and the
points. It needs the descriptors before their rotation, which a network computes."""

MAX_KEYPOINTS, GRAY = f"{PREFIX}max_keypoints", f"{PREFIX}gray"
"""Tensors of `POINTS_GRAPH`: the maximum number of keypoints, (1,) int64, which is an initializer,
and the luma from 0 to 255, (B, 1, H, W) float32."""


def pretrained_weights(name: str = "default") -> Path:
    """Return the path of bundled weights; an OptionError for an unknown name suggests another."""
    return (FOLDER / look_up("name or file of weights", name, PRETRAINED)).with_suffix(".onnx")


def resolve_weights(weights: str | Path) -> Path:
    """Return the path of weights, given by a name in `PRETRAINED` or as a file."""
    path = Path(weights) if names_a_file(weights) else pretrained_weights(str(weights))
    if not path.is_file():
        raise MissingWeightsError(f"there is no weights file {path}: check the path")
    return path
