"""What `deepdetect doctor` looks at: each check returns findings and never raises.

To add a check, write a function that returns findings and add it to `CHECKS`.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .._shared.errors import WITHOUT_GPU, DeepDetectError
from ._findings import Finding, as_sentence

if TYPE_CHECKING:
    import numpy as np

PURPOSES = {
    "benchmark": "`benchmark`, and `evaluate` with the Oxford scenes",
    "data": "`datasets get`",
    "demo": "`demo`",
    "faiss": "the matcher faiss",
    "hdf5": "`extract`, `match-many` and `export hloc`",
    "labels": "`label` and `train`, with all nine detectors",
    "match": "guided matching, `register`, `stitch` and `reconstruct`",
    "onnx": "`export onnx`",
    "opencv": "everything that reads or writes pictures",
    "openvino": "a faster network on CPUs",
    "ray": "`extract`, `match-many`, `label` and `shards` on a cluster",
    "sfm": "`reconstruct` of three photographs and more, `export colmap`, and visual odometry",
    "standard": "detection and matching",
    "train": "`train`, `average`, and weights in .safetensors",
}
"""What each extra of the package is for."""

MIN_FREE_BYTES = 200_000_000
"""On a disk that is written to: what numba compiles takes about 20 MB, results much more."""

MIN_MEMORY_BYTES = 1_000_000_000
"""Available: the network takes 150 bytes a pixel, at two megapixels 0.3 GB."""

MAX_BACKEND_DIFFERENCE = 5e-3
"""Between the probabilities of two back ends; five times what is usual."""

SAFETENSORS = ".safetensors"


def check_package() -> Iterator[Finding]:
    """Which versions of the package and of Python these are, and where."""
    from .. import __version__

    folder = Path(__file__).parents[1]
    details = {"version": __version__, "folder": str(folder)}
    yield Finding("deepdetect", "ok", f"{__version__}, {folder}", details=details)
    versions = {"version": platform.python_version(), "executable": sys.executable}
    yield Finding(
        "Python",
        "ok",
        f"{versions['version']}, {sys.executable}, {platform.platform()}",
        details=versions | {"platform": platform.platform()},
    )


def check_opencv() -> Iterator[Finding]:
    """Which OpenCV is imported, and whether packages of it have overwritten one another."""
    from .._shared.opencv import import_opencv, installed_distributions, opencv_factory

    found = {name: importlib.metadata.version(name) for name in installed_distributions()}
    listed = ", ".join(f"{name} {version}" for name, version in found.items())
    details: dict[str, Any] = {"packages": found}
    if len(found) > 1:
        keep = next((name for name in found if "contrib" in name), next(iter(found)))
        yield Finding(
            "OpenCV",
            "problem",
            f"{len(found)} packages have written into one folder: {listed}",
            f"Keep one of them: pip uninstall -y {' '.join(found)}, then pip install {keep}.",
            details,
        )
        return
    try:
        opencv = import_opencv()
    except (DeepDetectError, MemoryError) as error:
        yield Finding("OpenCV", "problem", "cannot be used", as_sentence(error), details)
        return
    details |= {"version": opencv.__version__, "file": opencv.__file__}
    for name, version in found.items():
        if _numbers(version)[:3] != _numbers(opencv.__version__)[:3]:
            yield Finding(
                "OpenCV",
                "problem",
                f"{opencv.__version__} is imported, though {name} {version} is installed",
                f"Another package has written over it, or hides it at {opencv.__file__}: pip "
                f"install --force-reinstall --no-deps {name}, or remove the other one.",
                details,
            )
            return
    try:
        opencv_factory("AgastFeatureDetector_create")
        modules = "with the contrib modules that labels need"
        details["labels"] = True
    except DeepDetectError:
        modules = "without the contrib modules, which only labels and training need"
        details["labels"] = False
    origin = listed or "not from PyPI"
    yield Finding("OpenCV", "ok", f"{opencv.__version__} ({origin}), {modules}", details=details)


def check_weights() -> Iterator[Finding]:
    """Whether the bundled weights are there."""
    from ..detector.pretrained import PRETRAINED, RANKER, pretrained_weights

    files = [
        pretrained_weights(name, suffix) for name in PRETRAINED for suffix in (".onnx", SAFETENSORS)
    ]
    absent = [path.name for path in (*files, RANKER) if not _has_content(path)]
    if absent:
        yield Finding(
            "weights",
            "problem",
            f"not complete: {', '.join(absent)}",
            "Install the package again: pip install --force-reinstall --no-deps deepdetect.",
            {"absent": absent},
        )
    else:
        names = list(PRETRAINED)
        yield Finding("weights", "ok", ", ".join(names), details={"names": names})


def check_backends() -> Iterator[Finding]:
    """Which back ends run the network, and whether they agree."""
    from ..detector.backends.options import BACKENDS, RuntimeOptions
    from ..detector.backends.registry import open_network
    from ..detector.pretrained import pretrained_weights
    from ._self_test import PICTURE_SIZE, textured_picture

    chosen = None
    reference = None
    for name in BACKENDS:
        suffix = SAFETENSORS if name == "torch" else ".onnx"
        label = f"back end {name}"
        if importlib.util.find_spec(name) is None:
            if name == "onnxruntime":  # the others are extras
                advice = "Install it: pip install onnxruntime."
                yield Finding(label, "problem", "not installed", advice, {"installed": False})
            continue
        try:
            start = time.perf_counter()
            network, _ = open_network(pretrained_weights(suffix=suffix), RuntimeOptions(name))
            image = (
                textured_picture(PICTURE_SIZE)[None].transpose(0, 3, 1, 2).astype("float32") / 255
            )
            logits = network(image)
        except Exception as error:  # a broken installation raises anything
            yield Finding(label, "problem", "does not run", _repair(name, error))
            continue
        probability = _sigmoid(logits)
        # Not by the name of the distribution: onnxruntime-gpu brings onnxruntime, too.
        version = str(getattr(sys.modules[name], "__version__", "of unknown version"))
        details: dict[str, Any] = {"installed": True, "version": version}
        difference = 0.0
        if reference is None:
            reference = probability
        else:
            difference = float(abs(probability - reference).max())
            details["max_difference"] = difference
        if difference > MAX_BACKEND_DIFFERENCE:
            yield Finding(
                label,
                "problem",
                f"{version}; its probabilities differ from the others' by up to {difference:.2g}",
                f"Choose another one by --backend, or install another version of {name}.",
                details,
            )
            continue
        if chosen is None or name == "openvino":  # as `--backend auto` chooses
            chosen = name
        seconds = f"loads and runs in {time.perf_counter() - start:.2f} s"
        also = f", probabilities agree to {difference:.0e}" if difference else ""
        yield Finding(label, "ok", f"{version}, {seconds}{also}", details=details)
        if name == "openvino":
            yield _bfloat16()
    if chosen:
        yield Finding("back end in use", "ok", chosen, details={"name": chosen})


def _bfloat16() -> Finding:
    """Say whether the precision that only OpenVINO has can be chosen here."""
    from ..detector.backends.openvino_backend import computes_bfloat16

    there = computes_bfloat16()
    value = (
        "this processor computes it: --precision bfloat16 is faster, and moves a few keypoints"
        if there
        else "this processor has no instructions for it: --precision bfloat16 is refused"
    )
    return Finding("bfloat16", "ok", value, details={"available": there})


def check_compiler() -> Iterator[Finding]:
    """Whether numba can be imported, and where it keeps what it compiles."""
    from .._shared.kernels import has_compiler

    if not has_compiler():
        return  # listed among the extras
    try:
        from ..features.suppression_kernel import keep_distant
    except Exception as error:  # it refuses some versions of NumPy
        yield Finding("numba", "problem", "cannot be imported", _repair("numba", error))
        return
    folder = keep_distant.stats.cache_path
    details = {"version": _version("numba"), "cache": folder}
    if folder is None:
        yield Finding(
            "numba",
            "warning",
            f"{details['version']}; no folder for what it compiles",
            "Set NUMBA_CACHE_DIR to a folder that can be written, or guided matching takes ten "
            "seconds longer in each process.",
            details,
        )
        return
    yield Finding("numba", "ok", f"{details['version']}, cache in {folder}", details=details)


def check_folders() -> Iterator[Finding]:
    """Whether results and temporary files can be written."""
    places = {"this folder": Path.cwd(), "temporary folder": Path(tempfile.gettempdir())}
    for name, folder in places.items():
        free = shutil.disk_usage(folder).free
        details = {"folder": str(folder), "free_bytes": free}
        try:
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError as error:
            yield Finding(
                name,
                "warning",
                f"{folder} cannot be written ({error.strerror})",
                "Name another folder for the results by -o."
                if name == "this folder"
                else "Set TMPDIR to a folder that can be written.",
                details | {"writable": False},
            )
            continue
        small = free < MIN_FREE_BYTES
        yield Finding(
            name,
            "warning" if small else "ok",
            f"{folder}, {free / 1e9:.1f} GB free",
            "Make room on its disk." if small else "",
            details | {"writable": True},
        )


def check_processors() -> Iterator[Finding]:
    """How many processors and threads, and how much memory there is."""
    from .._shared.parallel import available_memory, processor_count

    count, there = processor_count(), os.cpu_count() or 1
    named = {
        name: value
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        if (value := os.environ.get(name))
    }
    details: dict[str, Any] = {"usable": count, "of": there, "variables": named}
    value = f"{count} of {there} may be used"
    if named:
        value += "; " + ", ".join(f"{name}={number}" for name, number in named.items())
    quota = _processor_quota()
    if quota is not None and quota < count:
        yield Finding(
            "processors",
            "warning",
            f"{value}; the container's limit is {quota:g}",
            f"Give --threads {max(1, int(quota))}: more threads than that wait for one another.",
            details | {"quota": quota},
        )
    else:
        yield Finding("processors", "ok", value, details=details)
    memory = available_memory()
    small = memory < MIN_MEMORY_BYTES
    yield Finding(
        "memory",
        "warning" if small else "ok",
        f"{memory / 1e9:.1f} GB available",
        "Close other programs, or give --tile-megapixels 1." if small else "",
        {"available_bytes": memory},
    )


def check_extras() -> Iterator[Finding]:
    """Which optional packages are missing, for what, and which are too old."""
    from .._shared.opencv import import_opencv, installed_distributions, opencv_factory

    try:
        requirements = importlib.metadata.requires("deepdetect") or []
    except importlib.metadata.PackageNotFoundError:
        yield Finding(
            "extras",
            "warning",
            "unknown: the package is imported from a folder, and not installed",
            "Install it: pip install --editable . in its repository.",
        )
        return
    extras: dict[str, list[str]] = {}
    for text in requirements:
        if marker := re.search(r"extra\s*==\s*['\"]([\w-]+)", text):
            extras.setdefault(marker[1], []).append(text)
    for extra, needed in extras.items():
        lacking = []
        for text in needed:
            package, lowest = _requirement(text)
            if package.startswith("opencv"):  # any of its packages does
                try:
                    import_opencv()
                    if "contrib" in package:
                        opencv_factory("AgastFeatureDetector_create")
                except (DeepDetectError, MemoryError):
                    lacking.append(package)
            elif (version := _version(package)) is None:
                lacking.append(package)
            elif _numbers(version) < lowest:
                lowest_text = ".".join(map(str, lowest))
                lacking.append(f"{package} {lowest_text} or later (not {version})")
        purpose = PURPOSES.get(extra, "")
        details = {"extra": extra, "purpose": purpose, "lacking": lacking}
        name = f"extra {extra}"
        if not lacking:
            yield Finding(name, "ok", f"for {purpose}", details=details)
            continue
        install = f'pip install "deepdetect[{extra}]"'
        if extra == "labels" and (others := installed_distributions()):  # it would be a second one
            install = f"pip uninstall -y {' '.join(others)}, then {install}"
        if "torch" in lacking:
            install = f"{install}, {WITHOUT_GPU}"
        details["install"] = install
        yield Finding(
            name, "missing", f"for {purpose}; lacks {', '.join(lacking)}", details=details
        )


CHECKS: tuple[Callable[[], Iterator[Finding]], ...] = (
    check_package,
    check_processors,
    check_folders,
    check_opencv,
    check_weights,
    check_backends,
    check_compiler,
    check_extras,
)
"""All but the self-test, in their order."""


def _sigmoid(logits: np.ndarray) -> np.ndarray:
    import numpy as np

    probability: np.ndarray = 1 / (1 + np.exp(-np.clip(logits, -60, 60)))
    return probability


def _has_content(path: Path) -> bool:
    return path.is_file() and path.stat().st_size > 0


def _requirement(text: str) -> tuple[str, tuple[int, ...]]:
    """Return the name and the lowest version of a requirement."""
    name = re.match(r"[\w.-]+", text)
    lowest = re.search(r">=\s*([\d.]+)", text)
    return name[0] if name else text, _numbers(lowest[1]) if lowest else ()


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _processor_quota() -> float | None:
    """Return the processors that a container may use (control group, version 2), if limited."""
    try:
        quota, period = Path("/sys/fs/cgroup/cpu.max").read_text().split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError):
        return None


def _repair(package: str, error: BaseException) -> str:
    if isinstance(error, DeepDetectError):
        return as_sentence(error)
    return f"Install it again (pip install --force-reinstall {package}): {as_sentence(error)}"


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers that a version begins with."""
    match = re.match(r"\d+(?:\.\d+)*", version)
    return tuple(int(part) for part in match[0].split(".")) if match else ()
