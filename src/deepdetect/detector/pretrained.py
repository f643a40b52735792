"""The weights inside the package: one line each."""

from __future__ import annotations

from pathlib import Path

from .._shared.registry import look_up, resolve_name_or_path

FOLDER = Path(__file__).parent / "weights"

RANKER = Path(__file__).parent / "points" / "ranker.npz"
"""The trained ranker of points; its card is beside it."""

PRETRAINED: dict[str, str] = {
    "default": "default",  # photographs in any light
    "dense": "dense",  # two views of a scene in normal light, denser
    "free": "free",  # as default, from photographs of free licences alone
}
"""File names without ending, by the names that users choose them by."""


def pretrained_weights(name: str = "default", suffix: str = ".onnx") -> Path:
    """Return the path of weights inside the package.

    Args:
        name: "default", for all purposes and in the dark; "dense", for the geometry of
            scenes in normal light; or "free", as "default" but trained on photographs of
            free licences alone.
        suffix: ".onnx", or ".safetensors" for training.

    Raises:
        OptionError: the name is unknown (the nearest right one is named).

    Example:
        >>> pretrained_weights("dense").name
        'dense.onnx'
    """
    return (FOLDER / look_up("weights", name, PRETRAINED)).with_suffix(suffix)


def resolve_weights(weights: str | Path, suffix: str = ".onnx") -> Path:
    """Return the path of weights that are named, or are a file.

    Args:
        weights: a name of `PRETRAINED`, or a path (`is_path`).
        suffix: as of `pretrained_weights`.

    Raises:
        OptionError: it is a word that is no name.

    Example:
        >>> resolve_weights("run/best.safetensors").name
        'best.safetensors'
    """
    found = resolve_name_or_path("weights", weights, PRETRAINED)
    if isinstance(found, Path):
        return found
    return pretrained_weights(str(weights), suffix)
