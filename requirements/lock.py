"""Make the lock files of this folder with uv, or check that they agree with pyproject.toml.

python requirements/lock.py              # `make lock`: only what pyproject.toml asks for
python requirements/lock.py --upgrade    # `make upgrade`: everything to its newest version
python requirements/lock.py --check      # `make check-lock`: needs no network
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

FOLDER = Path(__file__).resolve().parent
PROJECT = tomllib.loads((FOLDER.parent / "pyproject.toml").read_text())

# torch.txt pins torch. Its builds for CUDA bring gigabytes of further packages, those for the
# processor bring the following, so that these can be locked for both.
TORCH_METADATA = """
[[dependency-metadata]]
name = "torch"
requires-dist = [
    "filelock", "fsspec>=0.8.5", "jinja2", "networkx>=2.5.1", "setuptools>=77.0.3",
    "sympy>=1.13.3", "typing-extensions>=4.10.0",
]
"""


@dataclass(frozen=True)
class LockFile:
    """What a lock file holds: the package with its extras, or only dependency groups."""

    name: str
    groups: tuple[str, ...]
    extras: tuple[str, ...] = ()
    package: bool = True
    overrides: str = "requirements/opencv.in"
    lowest: bool = False


EXTRAS = ("all", "train")
LOCK_FILES = (
    LockFile("uv.txt", groups=("lock",), package=False),
    LockFile("lock.txt", groups=("dev",), extras=EXTRAS),
    LockFile("demo.txt", groups=("build", "demo")),
    LockFile(
        "opencv4.txt",
        groups=("build", "test", "benchmark"),
        overrides="requirements/opencv4.in",
    ),
    LockFile("ray.txt", groups=("build", "test", "ray")),
    LockFile(
        "integrations.txt", groups=("build", "test", "demo", "integrations"), extras=("train",)
    ),
    LockFile("docs.txt", groups=("build", "demo", "docs", "release", "test")),
    LockFile("lowest.txt", groups=("build", "test"), extras=EXTRAS, lowest=True),
)


def make(lock: LockFile, *, upgrade: bool) -> None:
    """Write a lock file; versions that are in it stay as long as they fit."""
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder, "uv.toml")
        config.write_text(TORCH_METADATA)
        command = [
            *(sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--generate-hashes"),
            *("--config-file", config, "--constraints", "requirements/torch.txt"),
            *("--no-emit-package", "torch"),
            *("--python-version", "3.11", "--custom-compile-command", "make lock"),
            *("--output-file", f"requirements/{lock.name}"),
            *(["pyproject.toml"] if lock.package else []),
            *(option for extra in lock.extras for option in ("--extra", extra)),
            *(option for group in lock.groups for option in ("--group", group)),
            *("--overrides", lock.overrides),
            *(["--resolution", "lowest-direct"] if lock.lowest else ["--universal"]),
            # Otherwise uv keeps locked versions that fit, though lower ones may be allowed by now.
            *(f"--upgrade-package={each.name}" for each in _declared(lock) if lock.lowest),
            *(["--upgrade"] if upgrade else []),
        ]
        subprocess.run(command, cwd=FOLDER.parent, check=True)


def _group(name: str) -> list[str]:
    """Return the requirements of a dependency group and of those it includes."""
    entries: list[Any] = PROJECT["dependency-groups"][name]
    return [
        requirement
        for entry in entries
        for requirement in (_group(entry["include-group"]) if isinstance(entry, dict) else [entry])
    ]


def _extra(name: str) -> list[str]:
    """Return the requirements of an extra and of those of this package that it includes."""
    found = []
    for text in PROJECT["project"]["optional-dependencies"][name]:
        requirement = Requirement(text)
        if requirement.name == PROJECT["project"]["name"]:
            found += [each for inner in requirement.extras for each in _extra(inner)]
        else:
            found.append(text)
    return found


def _declared(lock: LockFile) -> list[Requirement]:
    """Return what pyproject.toml asks for in a lock file."""
    project = PROJECT["project"]
    listed = [requirement for group in lock.groups for requirement in _group(group)]
    if lock.package:
        listed += project["dependencies"]
    if "build" in lock.groups or "dev" in lock.groups:
        listed += PROJECT["build-system"]["requires"]
    for extra in lock.extras:
        listed += _extra(extra)
    text = re.sub("#.*", "", (FOLDER.parent / lock.overrides).read_text())
    overrides = [Requirement(line) for line in text.splitlines() if line]
    left_out = {each.name for each in overrides if each.marker} | {project["name"]}
    declared = [Requirement(text) for text in listed] + overrides
    return [each for each in declared if each.name not in left_out]


def _is_lowest(version: Version, requirement: Requirement) -> bool:
    """Tell whether a version begins with the lower bound of a requirement: 4.12.0.88 of 4.12."""
    bounds = [Version(part.version) for part in requirement.specifier if part.operator == ">="]
    return all(version.release[: len(bound.release)] == bound.release for bound in bounds)


def problems(lock: LockFile) -> list[str]:
    """Return in what a lock file does not agree with pyproject.toml."""
    text = (FOLDER / lock.name).read_text() if (FOLDER / lock.name).is_file() else ""
    entry = re.compile(r"^([\w.-]+)==(\S+)(.*\\\n(?: +--hash=.*\n)+)?((?: +#.*\n)*)", re.M)
    pins: dict[str, list[Version]] = {}
    direct: set[str] = set()
    found: list[str] = []
    for name, version, hashes, comments in entry.findall(text):
        if "== 'never'" in hashes:  # by an override
            continue
        pins.setdefault(canonicalize_name(name), []).append(Version(version))
        if "pyproject.toml" in comments:
            direct.add(canonicalize_name(name))
        if not hashes:
            found.append(f"{name} has no hash")
    torch = Requirement((FOLDER / "torch.txt").read_text().splitlines()[-1])
    pins["torch"] = [Version(part.version) for part in torch.specifier]
    declared = _declared(lock)
    for requirement in declared:
        name = canonicalize_name(requirement.name)
        if name not in pins:
            found.append(f"{name} is missing")
        for version in pins.get(name, []):
            if version not in requirement.specifier:
                found.append(f"{name} {version} is locked, pyproject.toml wants {requirement}")
            elif lock.lowest and name != "torch" and not _is_lowest(version, requirement):
                found.append(f"{name} {version} is not the lowest version of {requirement}")
    named = {canonicalize_name(requirement.name) for requirement in declared}
    found += [f"{name} is locked, but no longer in pyproject.toml" for name in direct - named]
    return [f"requirements/{lock.name}: {line}" for line in sorted(set(found))]


def main() -> None:
    """Make or check all lock files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="check only, without network")
    parser.add_argument("--upgrade", action="store_true", help="take the newest versions")
    options = parser.parse_args()
    if not options.check:
        for lock in LOCK_FILES:
            make(lock, upgrade=options.upgrade)
    found = [line for lock in LOCK_FILES for line in problems(lock)]
    if found:
        sys.exit("\n".join([*found, "The lock files do not agree with pyproject.toml: make lock"]))
    print(f"{len(LOCK_FILES)} lock files agree with pyproject.toml")


if __name__ == "__main__":
    main()
