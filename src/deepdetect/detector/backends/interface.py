"""What all backends share: options, sessions, and a network that maps images to logits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from ..._shared.errors import DeepDetectError, OptionError, WeightsError, first_line
from ..._shared.options import suggest_keywords
from ..pretrained import LOGITS, PADDED_LOGITS

PROBE_SHAPE = (24, 32)
"""Height and width in pixels of the noise image that tests a loaded network. Chosen by hand."""


class Network(Protocol):
    """A network that a backend has loaded, ready to run."""

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Map images, (N, 3, H, W) float32 in [0, 1], to finite logits, (N, 1, H, W) float32.

        H and W are multiples of 8. Lack of memory raises a MemoryError, and an output of a wrong
        shape or type a WeightsError.
        """


@suggest_keywords
@dataclass(frozen=True)
class RuntimeOptions:
    """How networks are run. The fields are options of `DeepDetect` and `PointDetector`."""

    backend: str = "auto"
    device: str = "cpu"
    threads: int | None = None
    precision: str = "float32"


class Session(Protocol):
    """An ONNX graph that a runtime has loaded. `inputs` and `outputs` are the tensors' names."""

    inputs: list[str]
    outputs: list[str]

    def run(self, outputs: Sequence[str], given: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Compute outputs. Exceptions are those of the runtime."""

    def reload(self) -> None:
        """Load the graph again before the next run, if a failed run may have damaged it."""

    def release_memory(self, smallest: Mapping[str, np.ndarray]) -> None:
        """Release the memory kept between runs; `smallest` are inputs that need little memory."""


def run_graph(
    session: Session, outputs: Sequence[str], given: Mapping[str, np.ndarray], what: str
) -> list[np.ndarray]:
    """Compute outputs; a failure names `what` failed, or is a MemoryError if memory was short."""
    try:
        return session.run(outputs, given)
    except Exception as error:  # the runtimes' exceptions share no base class
        session.reload()
        if any(word in f"{type(error).__name__} {error}" for word in ("MemoryError", "alloc")):
            raise MemoryError(str(error)) from None
        raise DeepDetectError(
            f"the network failed on {what} ({_reason(error)}): use another backend or device"
        ) from None


class OnnxNetwork:
    """A network that a session of a runtime runs.

    `onnx_path` is its file, of which tiles run parts; None if it cannot run in tiles.
    """

    def __init__(self, session: Session, path: Path, options: RuntimeOptions) -> None:
        self._session, self._path, self.threads = session, path, options.threads
        self._input = session.inputs[0]
        known = (name for name in (LOGITS, PADDED_LOGITS) if name in session.outputs)
        self._output = next(known, session.outputs[0])
        # Tiles, which are for float32 only, read the parts of the network from `onnx_path`.
        self.onnx_path = path if options.precision == "float32" else None
        self._works = False  # whether a run has given a correct result

    def __call__(self, image: np.ndarray) -> np.ndarray:
        height, width = image.shape[2:]
        what = f"an image of {width}x{height} pixels"
        (output,) = run_graph(self._session, [self._output], {self._input: image}, what)
        # If memory is short, OpenVINO may return an empty map or that of the previous image.
        if self._works and output.shape[2:] != image.shape[2:]:
            self._session.reload()
            raise MemoryError("the runtime gave a map of another size than the image")
        logits = as_logits(output, self._output, image.shape, self._path)
        self._works = True
        return logits

    def release_memory(self) -> None:
        """Release the memory that the session keeps between runs."""
        self._session.release_memory({self._input: np.zeros((1, 3, *PROBE_SHAPE), np.float32)})


def as_logits(
    output: np.ndarray, name: str, image_shape: tuple[int, ...], path: Path
) -> np.ndarray:
    """Check a network's output, and convert it to (N, 1, H, W) float32 logits.

    Probabilities that float32 rounds to 0 or 1 are clipped, as their logits would be infinite.
    """
    wanted = (image_shape[0], 1, *image_shape[2:])
    if output.shape != wanted or output.dtype != np.float32:
        raise WeightsError(
            f"{path} does not fit: it gives a {output.dtype} map of shape {output.shape} for an "
            f"image whose map must be float32 of shape {wanted}; use other weights"
        )
    low, high = float(output.min()), float(output.max())  # both are NaN if any value is NaN
    if not (np.isfinite(low) and np.isfinite(high)):
        raise WeightsError(
            f"{path} gives values that are not finite: it is damaged, or its training diverged; "
            "use other weights"
        )
    if name in (LOGITS, PADDED_LOGITS):
        return output
    if low < 0 or high > 1:
        raise WeightsError(
            f"{path} gives values from {low:g} to {high:g}, which are not "
            f"probabilities: name the output {LOGITS!r} if it holds logits, or use other weights"
        )
    probability = np.clip(output.astype(np.float64), 1e-38, 1 - 2.0**-25)
    return np.log(probability / (1 - probability)).astype(np.float32)


def unreadable(path: Path, error: Exception) -> WeightsError:
    """Return the error for a file that a runtime cannot read."""
    return WeightsError(
        f"{path} is not an ONNX file that can be read ({_reason(error)}): download it again"
    )


def not_started(device: str, reason: object) -> OptionError:
    """Return the error for a device that a runtime knows but cannot start."""
    return OptionError(
        f"the device {device} could not start ({first_line(reason)}): check its driver "
        "and libraries, or leave `device` out"
    )


def _reason(error: Exception) -> str:
    """Return the line of a runtime's error message that gives the reason: the last for OpenVINO."""
    reason = first_line(error)
    return str(error).strip().splitlines()[-1] if reason.startswith("Exception from") else reason
