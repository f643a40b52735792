"""The check that an ONNX file is a network of ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import WeightsError

Shape = Sequence[int | str | None]


def check_network(
    path: Path, inputs: Sequence[Shape], outputs: Sequence[Shape], types: set[str]
) -> None:
    """Check that a network maps one RGB image to one map, for any size.

    Args:
        path: the file, for the message.
        inputs, outputs: their shapes; a free dimension is no number.
        types: names of all their number types.

    Raises:
        WeightsError: the shapes or the types do not fit.
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
    if types != {"float32"}:
        raise WeightsError(
            f"{path} does not fit: it computes with {', '.join(sorted(types))}, "
            "and must take and give float32"
        )


def _like(shape: Shape, channels: int) -> bool:
    if len(shape) != 4 or (isinstance(shape[0], int) and shape[0] != 1):
        return False
    if isinstance(shape[1], int) and shape[1] != channels:
        return False
    return not any(isinstance(side, int) for side in shape[2:])


def _text(shapes: Sequence[Shape]) -> str:
    return ", ".join("(" + ", ".join(str(side) for side in shape) + ")" for shape in shapes)
