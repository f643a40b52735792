"""The check that an ONNX file is a network of ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import WeightsError

Shape = Sequence[int | str | None]


def check_shapes(path: Path, inputs: Sequence[Shape], outputs: Sequence[Shape]) -> None:
    """Check that a network maps one RGB image to one map, for any size.

    Args:
        path: the file, for the message.
        inputs, outputs: their shapes; a free dimension is no number.

    Raises:
        WeightsError: the shapes do not fit.
    """
    fits = (
        len(inputs) == len(outputs) == 1
        and _like(inputs[0], channels=3)
        and _like(outputs[0], channels=1)
    )
    if not fits:
        raise WeightsError(
            f"{path} does not fit: it maps {_text(inputs)} to {_text(outputs)}, and must map "
            "one image (1, 3, height, width) to one map (1, 1, height, width) of any size"
        )


def _like(shape: Shape, channels: int) -> bool:
    if len(shape) != 4 or (isinstance(shape[1], int) and shape[1] != channels):
        return False
    return not any(isinstance(side, int) for side in shape[2:])


def _text(shapes: Sequence[Shape]) -> str:
    return ", ".join("(" + ", ".join(str(side) for side in shape) + ")" for shape in shapes)
