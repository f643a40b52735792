"""The checks that an ONNX file is a network of ours, and that it answers like one."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from ..._shared.errors import DeepDetectError, WeightsError

Shape = Sequence[int | str | None]

LOGITS = "logits"
"""Name of the output that holds logits; an output of another name holds probabilities."""

KEYPOINT_OUTPUTS = frozenset({"keypoints", "keypoint_logits"})
"""Names of the outputs of files that give keypoints, too: these are not read."""

PADDED_IMAGE = "padded_image"
"""Name of the tensor that holds the image, padded to multiples of 8, in files that pad it."""

PROBE_SHAPE = (24, 32)
"""Height and width of the image that a network is tried on."""


def check_network(
    path: Path, inputs: Sequence[Shape], outputs: Sequence[Shape], types: set[str]
) -> None:
    """Check that a network maps one RGB image to a map or two, for any size.

    Args:
        path: the file, for the message.
        inputs, outputs: their shapes; a free dimension is no number.
        types: names of all their number types.

    Raises:
        WeightsError: the shapes or the types do not fit.
    """
    fits = (
        len(inputs) == 1
        and len(outputs) in (1, 2)
        and _like(inputs[0], channels=3)
        and all(_like(output, channels=1) for output in outputs)
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


def output_to_read(names: Sequence[str]) -> str:
    """Choose the output to read: the logits, or the first where there are none."""
    return LOGITS if LOGITS in names else names[0]


def as_logits(
    output: np.ndarray, name: str, image_shape: tuple[int, ...], path: Path
) -> np.ndarray:
    """Check what a network returns, and turn probabilities into logits.

    Args:
        output: what the network returned.
        name: the output's name; probabilities unless it is "logits".
        image_shape: (N, 3, H, W) of the images.
        path: the weights file, for the message.

    Returns:
        (N, 1, H, W) float32 logits. Probabilities that float32 rounds to 0 or 1 become the
        logits of the nearest number that it holds.

    Raises:
        WeightsError: the map has another size, or a value is not finite or no probability.
    """
    wanted = (image_shape[0], 1, *image_shape[2:])
    if output.shape != wanted:
        raise WeightsError(
            f"{path} gives a map of shape {output.shape} for an image that needs {wanted}: "
            "use other weights"
        )
    low, high = float(output.min()), float(output.max())  # NaN where there is one
    if not (np.isfinite(low) and np.isfinite(high)):
        raise WeightsError(
            f"{path} gives values that are not finite: it is damaged, or its training diverged; "
            "use other weights"
        )
    if name == LOGITS:
        return output
    if low < 0 or high > 1:
        raise WeightsError(
            f"{path} gives values from {low:g} to {high:g}, which are no "
            f"probabilities: name the output {LOGITS!r} if it holds logits, or use other weights"
        )
    probability = np.clip(output.astype(np.float64), 1e-38, 1 - 2.0**-25)
    return np.log(probability / (1 - probability)).astype(np.float32)


def sanity_check(network: Callable[[np.ndarray], np.ndarray], path: Path) -> None:
    """Run a network on a small image of noise, so that a damaged one is refused when it is loaded.

    Raises:
        WeightsError: it gives a map of another size, values that are not finite or no
            probabilities, or the same value everywhere.
    """
    # Noise enough for this; importing NumPy's generators takes 6 MB.
    numbers = np.arange(3 * math.prod(PROBE_SHAPE), dtype=np.uint16) * np.uint16(40503)
    noise = numbers.reshape(1, 3, *PROBE_SHAPE).astype(np.float32) * np.float32(2**-16)
    logits = network(noise)
    if logits.min() == logits.max():
        raise WeightsError(
            f"{path} gives the same value at every pixel of an image of noise: it is damaged, or "
            "was never trained; use other weights"
        )


def failed_run(image_shape: tuple[int, ...], reason: str, otherwise: str) -> DeepDetectError:
    """Return the error of a run that failed.

    Args:
        image_shape: (N, 3, H, W) of the images.
        reason: what the runtime says.
        otherwise: what to use where one image failed.
    """
    number, _, height, width = image_shape
    what = (
        f"an image of {width}x{height}" if number == 1 else f"{number} images of {width}x{height}"
    )
    remedy = f"use a smaller one, or {otherwise}" if number == 1 else "use `batch_size=1`"
    return DeepDetectError(f"the network failed on {what} pixels ({reason}): {remedy}")


def lack_of_memory(image_shape: tuple[int, ...]) -> DeepDetectError:
    """Return the error for images, (N, 3, H, W), that the network lacks memory for."""
    number, _, height, width = image_shape
    if number > 1:
        return DeepDetectError(
            f"there is not enough memory to run the network on {number} images of "
            f"{width}x{height} pixels: use a smaller `batch_size`"
        )
    return DeepDetectError(
        f"there is not enough memory to run the network on {width}x{height} pixels: "
        "use `resolution='auto'`, or a smaller image"
    )


def _like(shape: Shape, channels: int) -> bool:
    if len(shape) != 4 or (isinstance(shape[0], int) and shape[0] != 1):
        return False
    if isinstance(shape[1], int) and shape[1] != channels:
        return False
    return not any(isinstance(side, int) for side in shape[2:])


def _text(shapes: Sequence[Shape]) -> str:
    return ", ".join("(" + ", ".join(str(side) for side in shape) + ")" for shape in shapes)
