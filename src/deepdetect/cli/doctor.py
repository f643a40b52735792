"""`deepdetect doctor`: what is installed, what works, what is missing for what."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import platform
import re
import sys
from collections.abc import Iterator
from typing import Literal, NamedTuple

import click

from .._shared.errors import DeepDetectError, install_command
from ._options import json_option, print_json, print_table

PURPOSES = {
    "app": "app",
    "benchmark": "benchmark, and evaluate with the Oxford scenes",
    "demo": "demo",
    "labels": "label and train, with all nine detectors",
    "onnx": "export onnx",
    "openvino": "a faster network on CPUs",
    "ray": "extract, match-many, label and shards on a cluster",
    "sfm": "reconstruct of three images and more, extract, match-many and export",
    "train": "train, average, and weights in .safetensors",
}
MAX_BACKEND_DIFFERENCE = 5e-3
"""Between the probabilities of two back ends; five times what is usual."""

MIN_PRECISION = 0.95
"""Of the self-test's matches within 1 px of the truth; all of them where nothing is wrong."""


class Finding(NamedTuple):
    """What a check found, and what to do about it."""

    name: str
    status: Literal["ok", "missing", "problem"]
    value: str
    remedy: str = ""


@click.command(short_help="Check the installation, and say what to do about it.")
@json_option
@click.pass_context
def doctor(context: click.Context, as_json: bool) -> None:
    """Check the installation: versions, OpenCV, back ends, and a self-test with a known answer.

    Ends with exit code 1 if something that is installed does not work. Nothing is sent anywhere;
    please add what --json prints to a report of a problem.

    \b
    deepdetect doctor
    deepdetect doctor --json > doctor.json
    """
    findings: list[Finding] = []
    for check in CHECKS:
        try:
            findings += check()
        except Exception as error:  # a broken installation raises anything
            kind = "" if isinstance(error, DeepDetectError) else f"{type(error).__name__}: "
            line = (str(error).splitlines() or [""])[0]
            findings.append(Finding(check.__name__, "problem", "does not work", kind + line))
    healthy = not any(finding.status == "problem" for finding in findings)
    if as_json:
        print_json({"ok": healthy, "findings": [finding._asdict() for finding in findings]})
    else:
        marks = {"ok": "", "problem": "PROBLEM: ", "missing": "not installed: "}
        print_table([(each.name, marks[each.status] + each.value) for each in findings])
        remedies = [(each.name, each.remedy) for each in findings if each.remedy]
        print_table(remedies, "\nwhat to do" if remedies else "\nall that is installed works")
    if not healthy:
        context.exit(1)


def packages() -> Iterator[Finding]:
    """Say which packages are there, which are too old, and what extras lack."""
    yield Finding("deepdetect", "ok", f"{importlib.metadata.version('deepdetect')}, {__file__}")
    yield Finding("Python", "ok", f"{platform.python_version()}, {sys.executable}")
    yield Finding("system", "ok", platform.platform())
    lacking: dict[str, list[str]] = {}
    for text in importlib.metadata.requires("deepdetect") or []:
        requirement, _, marker = text.partition(";")
        name, lowest = re.findall(r"^[\w.-]+|(?<=>=)[\d.]+", requirement + " >=0")[:2]
        if name == "deepdetect" or name.startswith("opencv"):  # any OpenCV will do
            continue
        extra = re.sub(r"\W|extra", "", marker)
        absent = lacking.setdefault(extra, [])
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            absent.append(name)
            continue
        if _numbers(version) < _numbers(lowest):
            absent.append(f"'{name}>={lowest}'")
        elif not extra:
            yield Finding(name, "ok", version)
    for extra, names in lacking.items():
        if names and extra:
            yield Finding(extra, "missing", f"{', '.join(names)}, for {PURPOSES.get(extra)}")
        elif names:
            yield Finding("packages", "problem", ", ".join(names), install_command(*names))


def opencv() -> Iterator[Finding]:
    """Say which OpenCV is imported: packages of it install over one another."""
    from .._shared.opencv import import_opencv, installed_distributions

    module, names = import_opencv(), installed_distributions()
    contrib = hasattr(module, "xfeatures2d") or hasattr(module, "AgastFeatureDetector_create")
    value = f"{module.__version__} ({', '.join(names) or 'of no package'}), "
    value += f"{'with' if contrib else 'without'} the modules that only labels need"
    last = max(names, key=lambda name: "contrib" in name, default="")
    installed = importlib.metadata.version(last) if last else module.__version__
    if _numbers(installed)[:3] == _numbers(module.__version__)[:3] and contrib >= (
        "contrib" in last
    ):
        yield Finding("OpenCV", "ok", value)
    else:
        remedy = f"pip install --force-reinstall --no-deps {last}"
        yield Finding("OpenCV", "problem", f"{value}, hides {last} {installed}", remedy)


def backends() -> Iterator[Finding]:
    """Run the network by each back end that is there, and compare what they say."""
    import numpy as np

    from ..detector.backends.options import BACKENDS, RuntimeOptions
    from ..detector.backends.registry import open_network
    from ..detector.pretrained import pretrained_weights

    planes = np.random.default_rng(0).random((1, 3, 240, 320), np.float32)
    first = None
    for name in BACKENDS:
        if importlib.util.find_spec(name) is None:
            continue  # listed among the packages
        weights = pretrained_weights(suffix=".safetensors" if name == "torch" else ".onnx")
        network, _ = open_network(weights, RuntimeOptions(name))
        answer = 1 / (1 + np.exp(-network(planes)))
        first = answer if first is None else first
        difference = float(abs(answer - first).max())
        value = f"probabilities within {difference:.0e} of the first"
        if difference <= MAX_BACKEND_DIFFERENCE:
            yield Finding(f"back end {name}", "ok", value)
        else:
            yield Finding(f"back end {name}", "problem", value, "Choose another one by --backend")


def self_test() -> Iterator[Finding]:
    """Detect and match two images whose shift is known."""
    import numpy as np

    from ..detector.detector import DeepDetect
    from ..detector.point_detector import PointDetector
    from ..matching.pipeline import match_images

    blocks = np.random.default_rng(0).integers(0, 256, (32, 42, 3), np.uint8)
    whole = blocks.repeat(8, 0).repeat(8, 1)
    whole[:64] = 128  # nothing to be found there
    first, second = whole[:240, :320], whole[4:244, 6:326]
    detector = DeepDetect()
    dense = detector.detect(first)
    points = PointDetector(256).detect(first)
    matches = match_images(first, second, detector)
    in_flat = (dense.xy[:, 1] < 48).sum()
    precision = np.mean(np.hypot(*(matches.points0 - matches.points1 - (6, 4)).T) < 1)
    value = f"{len(dense):,} dense keypoints, {len(points)} points, {len(matches):,} matches, "
    value += f"{precision:.1%} of them correct"
    right = len(dense) > 5_000 and not in_flat and len(points) > 100 and precision > MIN_PRECISION
    if right:
        yield Finding("self-test", "ok", value)
    else:
        remedy = "Try another --backend, and report what `deepdetect doctor --json` prints"
        yield Finding("self-test", "problem", f"wrong results: {value}", remedy)


CHECKS = (packages, opencv, backends, self_test)


def _numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)]
