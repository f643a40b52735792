"""`deepdetect doctor`: checks of the installed packages, a self-test and a benchmark."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import platform
import re
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal, NamedTuple

from cyclopts import Parameter

from .._shared.errors import DeepDetectError, first_line, install_command
from .._shared.opencv import import_opencv, installed_distributions, version_numbers
from ._options import Result, command, table

PURPOSES = {
    "all": "the fast back end, ONNX files, the demo, HEIC, camera raw and compressed TIFF",
    "app": "the page in a browser",
    "sfm": "reconstruct with three or more images, extract, match-many, export, georeferences",
}
MAX_BACKEND_DIFFERENCE = 5e-3
"""Probabilities of two back ends may differ by this much, five times the usual difference."""
TIMED_ROUNDS = 5
"""The benchmark times this many runs, after one that compiles functions. Chosen by hand."""
NEAR_SHIFT_PX = 16
"""Disparity in pixels of the foreground in the second pair of the self-test. Chosen by hand."""
MIN_PRECISION = 0.95
"""The self-test fails if fewer matches are correct to 1 px; usually all are. Chosen by hand."""


class Finding(NamedTuple):
    """The result of a check, and a remedy if there is a problem."""

    name: str
    status: Literal["ok", "missing", "problem"]
    value: str
    remedy: str = ""


@command()
def doctor(
    *,
    benchmark: Annotated[bool, Parameter(help="Measure how fast this computer is.")] = False,
) -> Result:
    """Check the installation: versions, OpenCV, back ends, and a self-test with a known answer.

    Ends with exit code 1 if an installed package does not work. Nothing is sent anywhere. If you
    report a problem, please add the output of --json.

        deepdetect doctor
        deepdetect doctor --benchmark
    """
    if benchmark:
        measured = speeds()
        ratios = measured.pop("ratios")
        rows = {
            name: f"{value:g}, {ratios[name]:.2f} of SIFT's time" if name in ratios else value
            for name, value in measured.items()
        }
        title = f"milliseconds, median of {TIMED_ROUNDS}"
        return Result({**measured, "ratios": ratios}, table(rows, title=title))
    findings: list[Finding] = []
    for check in CHECKS:
        try:
            findings += check()
        except Exception as error:  # a broken installation raises errors of any kind
            kind = "" if isinstance(error, DeepDetectError) else f"{type(error).__name__}: "
            reason = kind + first_line(error)
            findings.append(Finding(check.__name__, "problem", "does not work", reason))
    healthy = not any(finding.status == "problem" for finding in findings)
    marks = {"ok": "", "problem": "PROBLEM: ", "missing": "not installed: "}
    remedies = {each.name: each.remedy for each in findings if each.remedy}
    rows = {each.name: marks[each.status] + each.value for each in findings}
    text = table(rows, wrapped=True) + "\n\n"
    text += table(remedies, title="what to do") if remedies else "everything installed works"
    values = {"ok": healthy, "findings": [finding._asdict() for finding in findings]}
    return Result(values, text, exit_code=0 if healthy else 1)


def packages() -> Iterator[Finding]:
    """Report the versions of installed packages, and what is missing or outdated."""
    yield Finding("deepdetect", "ok", f"{importlib.metadata.version('deepdetect')}, {__file__}")
    yield Finding("Python", "ok", f"{platform.python_version()} on {platform.platform()}")
    lacking: dict[str, list[str]] = {}
    for text in importlib.metadata.requires("deepdetect") or []:
        requirement, _, marker = text.partition(";")
        name, lowest = re.findall(r"^[\w.-]+|(?<=>=)[\d.]+", requirement + " >=0")[:2]
        if name == "deepdetect" or name.startswith("opencv"):  # the check `opencv` covers OpenCV
            continue
        extra = re.sub(r"\W|extra", "", marker)
        absent = lacking.setdefault(extra, [])
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            absent.append(name)
            continue
        if version_numbers(version) < version_numbers(lowest):
            absent.append(f"'{name}>={lowest}'")
        elif not extra:
            yield Finding(name, "ok", version)
    for extra, names in lacking.items():
        if names and extra:
            yield Finding(extra, "missing", f"{', '.join(names)}, for {PURPOSES.get(extra)}")
        elif names:
            yield Finding("packages", "problem", ", ".join(names), install_command(*names))


def opencv() -> Iterator[Finding]:
    """Report which OpenCV is imported, because OpenCV's packages overwrite each other's files."""
    module, names = import_opencv(), installed_distributions()
    contrib = hasattr(module, "xfeatures2d") or hasattr(module, "AgastFeatureDetector_create")
    value = f"{module.__version__} ({', '.join(names) or 'from no package'}), "
    value += "with contrib modules" if contrib else "without the contrib modules that labels need"
    last = max(names, key=lambda name: "contrib" in name, default="")
    installed = importlib.metadata.version(last) if last else module.__version__
    same = version_numbers(installed)[:3] == version_numbers(module.__version__)[:3]
    if same and contrib >= ("contrib" in last):
        yield Finding("OpenCV", "ok", value)
    else:
        remedy = f"pip install --force-reinstall --no-deps {last}"
        yield Finding("OpenCV", "problem", f"{value}, hides {last} {installed}", remedy)


def self_test() -> Iterator[Finding]:
    """Detect with each back end, and match two synthetic pairs whose shifts are known.

    The first pair shows a plane, the second a plane with a nearer square.
    """
    import numpy as np

    from ..detector.backends import BACKENDS
    from ..detector.detector import DeepDetect
    from ..detector.point_detector import PointDetector
    from ..matching.pipeline import match_images
    from ..matching.stereo import disparity_map

    blocks = np.random.default_rng(0).integers(0, 256, (32, 42, 3), np.uint8)
    whole = blocks.repeat(8, 0).repeat(8, 1)
    first, second = whole[:240, :320], whole[4:244, 6:326]
    maps = {
        name: DeepDetect("default", backend=name).heatmap(first)
        for name in BACKENDS
        if importlib.util.find_spec(name)
    }
    for name, heatmap in maps.items():
        difference = float(abs(heatmap - next(iter(maps.values()))).max())
        agrees = difference <= MAX_BACKEND_DIFFERENCE
        value = f"probabilities within {difference:.0e} of the first back end's"
        remedy = "" if agrees else "choose another one with --backend"
        yield Finding(f"back end {name}", "ok" if agrees else "problem", value, remedy)
    points = PointDetector(256).detect(first)
    near = np.zeros(first.shape, bool)
    near[60:180, 120:240] = True
    behind = np.roll(first, -NEAR_SHIFT_PX, axis=1)
    third = np.where(np.roll(near, -NEAR_SHIFT_PX, axis=1), behind, first)
    errors = []
    for image, shift, off in ((second, (6, 4), (0, 0)), (third, (0, 0), (NEAR_SHIFT_PX, 0))):
        with warnings.catch_warnings(action="ignore"):  # matching warns of still parts
            matches = match_images(first, image)
        column, row = np.rint(matches.points0).astype(int).T
        expected = np.array(shift) + near[row, column, :1] * np.array(off)
        errors.append(np.hypot(*(matches.points0 - matches.points1 - expected).T))
    disparity_map(first, third)  # compiles and caches its functions for other commands
    wrong = np.concatenate(errors) >= 1
    precision, count = 1 - wrong.mean(), min(map(len, errors))
    value = f"{len(points)} points, {len(wrong):,} matches, {precision:.1%} of them correct"
    if len(points) > 100 and count > 5_000 and precision > MIN_PRECISION:
        yield Finding("self-test", "ok", value)
    else:
        remedy = "try another --backend, and report the output of `deepdetect doctor --json`"
        yield Finding("self-test", "problem", f"wrong results: {value}", remedy)


def speeds() -> dict[str, Any]:
    """Time detection and matching of images of 640x480 pixels, and the same by OpenCV's SIFT."""
    import numpy as np

    from .._shared.machine import processor_count, processor_name
    from .._shared.opencv import cv2
    from ..detector.detector import DeepDetect
    from ..detector.point_detector import PointDetector
    from ..matching.pipeline import match_features, match_images

    # Noise of all scales gives about as many keypoints as a photograph.
    rng, whole = np.random.default_rng(0), np.zeros((512, 672), np.float32)
    for octave in range(6):
        cells = rng.random((16 << octave, 21 << octave), np.float32)
        whole += cv2.resize(cells, (672, 512), interpolation=cv2.INTER_CUBIC) / (1 + octave) ** 0.5
    whole = cv2.normalize(whole, None, 0, 255, cv2.NORM_MINMAX, cv2.CV_8U)
    first, second = whole[:480, :640], whole[8:488, 12:652]
    network, points, sift = DeepDetect(), PointDetector(2048), cv2.SIFT_create(2048)
    both, matcher = (first, second), cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    alone, whole_pair, described = "SIFT, 2,048", "SIFT, a pair matched", "SIFT with descriptors"
    work: dict[str, Callable[[], object]] = {
        alone: lambda: sift.detect(first, None),
        described: lambda: sift.detectAndCompute(first, None),
        whole_pair: lambda: matcher.match(
            *(sift.detectAndCompute(image, None)[1] for image in both)
        ),
        "2,048 points": lambda: points.detect(first),
        "dense keypoints": lambda: network.detect(first),
        "points with descriptors": lambda: points.extract(first),
        "points, a pair matched": lambda: match_features(*map(points.extract, both)),
        "a pair matched, guided": lambda: match_images(*both),
    }
    compared = dict.fromkeys([*work][3:5], alone) | {"points with descriptors": described}
    compared |= dict.fromkeys([*work][6:], whole_pair)
    times: dict[str, list[float]] = {name: [] for name in work}
    for _ in range(1 + TIMED_ROUNDS):
        for name, run in work.items():
            begun = time.perf_counter()
            run()
            times[name].append(1000 * (time.perf_counter() - begun))
    return {
        "processor": f"{processor_name()}, {processor_count()} threads",
        "system": f"{platform.platform()}, Python {platform.python_version()}",
        "deepdetect": importlib.metadata.version("deepdetect"),
        "images": "640x480",
        **{name: round(statistics.median(each[1:]), 1) for name, each in times.items()},
        "ratios": {
            name: round(statistics.median(np.divide(times[name], times[other])[1:]), 3)
            for name, other in compared.items()
        },
    }


CHECKS = (packages, opencv, self_test)
