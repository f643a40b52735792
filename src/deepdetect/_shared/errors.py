"""Errors that a user can cause, and suggestions for misspelled names."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager


class DeepDetectError(Exception):
    """An error that the user can fix: its message says what is wrong and what to do.

    Most subclasses also inherit from the matching built-in error: `ValueError` for a wrong
    argument or wrong contents of a file, `FileNotFoundError` for a missing file, `ImportError` for
    a missing package. The command line prints the message without a traceback and ends with exit
    code 2, unless the subclass says otherwise.
    """


class ImageError(DeepDetectError, ValueError):
    """An image is missing, unreadable or too small, or has a wrong shape or type.

    It is a `ValueError`, and also a `FileNotFoundError` if the file is missing.
    """


class OptionError(DeepDetectError, ValueError):
    """An option has an unknown name or a value out of its range; a `ValueError`."""


class WeightsError(DeepDetectError, ValueError):
    """A weights file is missing, damaged, or does not fit the network.

    It is a `ValueError`, and also a `FileNotFoundError` if the file is missing.
    """


class ReconstructionError(DeepDetectError, ValueError):
    """A 3D reconstruction fails, for the reason in the message; a `ValueError`."""


class NoDepthError(ReconstructionError):
    """The images show no depth or do not overlap; the command line ends with exit code 3."""


class NoPlaceError(ReconstructionError):
    """Ground control points contradict the model; the command line ends with exit code 3."""


class MissingExtraError(DeepDetectError, ImportError):
    """A call needs an optional package that is not installed; an `ImportError`."""


class RegistrationError(DeepDetectError, ValueError):
    """No homography between the images can be trusted, or the trusted one cannot warp them."""


class MissingFileError(DeepDetectError, FileNotFoundError):
    """A file or folder is missing."""


class MissingImageError(ImageError, MissingFileError):
    """An image, or a folder of images, is missing."""


class MissingWeightsError(WeightsError, MissingFileError):
    """A weights file is missing."""


class MissingCalibrationError(ReconstructionError, MissingFileError):
    """A calibration file is missing."""


class InvalidFileError(DeepDetectError, ValueError):
    """A file is damaged, or is not of the expected kind; a `ValueError`."""


class BatchError(DeepDetectError):
    """Some of many files could not be processed; the others are done.

    The command line lists the failures, and ends with exit code 1.

    Args:
        summary: how many files failed, and what happened to the others.
        failures: a sentence on each failure, with the name of the file.
    """

    def __init__(self, summary: str, failures: Iterable[str]) -> None:
        self.summary, self.failures = summary, tuple(failures)
        super().__init__(f"{summary}; the first failure: {self.failures[0]}")

    def __reduce__(self) -> tuple[type[BatchError], tuple[str, tuple[str, ...]]]:
        return type(self), (self.summary, self.failures)


def first_line(error: object) -> str:
    """Return the first line of the message of an error, or its type if the message is empty."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def unknown_name(kind: str, name: object, known: Iterable[str]) -> OptionError:
    """Return an OptionError for an unknown name; it suggests the most similar known one."""
    import difflib

    names = list(known)
    spelled = {known_name.lower(): known_name for known_name in names}
    nearest = difflib.get_close_matches(str(name).lower(), spelled, n=1, cutoff=0.5)
    hint = f": did you mean {spelled[nearest[0]]!r}?" if nearest else ""
    return OptionError(f"unknown {kind} {name!r}{hint} (known: {', '.join(names)})")


def check_name(kind: str, name: object, known: Collection[object]) -> None:
    """Raise an OptionError for an unknown name; `kind` says what is named, such as "projection"."""
    if name not in known:
        raise unknown_name(kind, name, map(str, known))


WITHOUT_GPU = (
    "and if you have no GPU, add --extra-index-url https://download.pytorch.org/whl/cpu, "
    "which saves 6 GB"
)
"""Advice for the installation of torch: on Linux, pip installs the large CUDA build by default."""

DISTRIBUTIONS = {
    "hloc": "git+https://github.com/cvg/Hierarchical-Localization",
    "lightning_fabric": "lightning-fabric",
    "ray": "'ray[data]'",
    "skimage": "scikit-image",
}
"""Arguments of `pip install` for modules that are not installed under their own names."""


def install_command(*packages: str) -> str:
    """Return the command that installs modules, for the message of a `MissingExtraError`."""
    command = " ".join(["pip install", *(DISTRIBUTIONS.get(one, one) for one in packages)])
    return f"{command}, {WITHOUT_GPU}" if "torch" in packages else command


def require_packages(what: str, *packages: str) -> None:
    """Raise a MissingExtraError if one of the packages that `what` needs is not installed."""
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    if missing:
        names = f"package{'s' * (len(missing) > 1)} {', '.join(missing)}"
        raise MissingExtraError(f"{what} needs the {names}: run {install_command(*missing)}")


@contextmanager
def noted_failures(name: str, failures: list[str]) -> Iterator[None]:
    """If the block fails for the input `name`, add the error to `failures` instead of raising it.

    Errors that affect all inputs, such as a missing package or wrong weights, are still raised.
    """
    try:
        yield
    except (MissingExtraError, WeightsError):
        raise
    except DeepDetectError as error:
        failures.append(str(error) if name in str(error) else f"{name}: {error}")
    except MemoryError:
        failures.append(f"{name}: there is not enough memory: use a smaller image")


for _error in (
    DeepDetectError,
    ImageError,
    MissingExtraError,
    NoDepthError,
    OptionError,
    ReconstructionError,
    RegistrationError,
    WeightsError,
):
    # Tracebacks and `pickle` name this module, because users import the errors from it.
    _error.__module__ = "deepdetect"
