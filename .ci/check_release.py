"""Make the wheel and the source archive, look at them, and install them into empty environments.

python .ci/check_release.py                        # `make release-check`: each Python that is here
python .ci/check_release.py --version 0.2.0        # and the four places name this version
python .ci/check_release.py --pythons python3.12   # only this one

The packages that the wheel needs are fetched once for each Python. Then the wheel is installed from
that folder alone, without an index, and `deepdetect doctor` and `deepdetect detect` are run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
PYTHONS = tuple(f"python3.{minor}" for minor in range(11, 15))

IN_THE_WHEEL = (
    "deepdetect/py.typed",
    "deepdetect/__init__.pyi",
    "deepdetect/detector/weights/default.onnx",
    "deepdetect/detector/weights/dense.onnx",
    "deepdetect/detector/weights/free.onnx",
    "deepdetect/detector/weights/espnet.onnx",
    "deepdetect/detector/points/ranker.npz",
    "deepdetect/io/viewer.html",
)
IN_THE_ARCHIVE = ("README.md", "LICENSE", "CHANGELOG.md", "hatch_build.py", "mkdocs.yml", "tests")
NOT_IN_THE_WHEEL = r"\.(safetensors|csv|gz|tar)$"
"""What only training reads belongs to deepdetect-lab."""

MAX_WHEEL_BYTES = 9_000_000

DRAW = """
import numpy as np
from PIL import Image
picture = np.kron(np.random.default_rng(0).integers(0, 256, (30, 40, 3)), np.ones((8, 8, 1)))
Image.fromarray(picture.astype(np.uint8)).save("picture.png")
"""


def main() -> None:
    """Do all of it; the first thing that is wrong ends it with a sentence."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--version", help="what the package, changelog and citation must name")
    parser.add_argument("--pythons", nargs="+", default=PYTHONS, help="default: 3.11 to 3.14")
    parser.add_argument("--built", action="store_true", help="take the files that are in dist/")
    chosen = parser.parse_args()
    version = package_version()
    if chosen.version:
        check_version(chosen.version)
    wheel, archive = find_built() if chosen.built else build()
    check_contents(wheel, archive)
    pythons = {name: path for name in chosen.pythons if (path := find_python(name))}
    absent = [name for name in chosen.pythons if name not in pythons]
    if not pythons:
        fail(f"none of {', '.join(chosen.pythons)} is here: install one, or name it by --pythons")
    for name, path in pythons.items():
        check_installs(path, wheel, version)
        print(f"{name}: installs offline, doctor finds no problem, detect finds keypoints")
    first = next(iter(pythons.values()))
    check_archive_installs(first, archive, version)
    print("the source archive installs offline and detects")
    if absent:
        print(f"not tried, because not here: {', '.join(absent)}")


def package_version() -> str:
    """Return the version that the package names."""
    source = (ROOT / "src/deepdetect/__init__.py").read_text("utf-8")
    found = re.search(r'^__version__ = "(.+)"$', source, re.M)
    return found[1] if found else fail("src/deepdetect/__init__.py names no __version__")


def version_problems(version: str, root: Path = ROOT) -> list[str]:
    """Return which of the files do not name a version as a release must."""
    places = {
        "src/deepdetect/__init__.py": rf'^__version__ = "{re.escape(version)}"$',
        "CITATION.cff": rf"^version: {re.escape(version)}$",
        "CHANGELOG.md": rf"^## \[{re.escape(version)}\] - \d{{4}}-\d\d-\d\d$",
    }
    return [
        f"{name} does not name version {version}"
        for name, pattern in places.items()
        if not re.search(pattern, (root / name).read_text("utf-8"), re.M)
    ]


def check_version(version: str) -> None:
    """End where a file names another version."""
    if problems := version_problems(version):
        fail("; ".join(problems))
    print(f"the package, CITATION.cff and CHANGELOG.md name {version}")


def build() -> tuple[Path, Path]:
    """Make both files, the wheel from the source archive, and have twine look at them."""
    shutil.rmtree(DIST, ignore_errors=True)
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", str(DIST), str(ROOT)])
    wheel, archive = find_built()
    run([sys.executable, "-m", "twine", "check", "--strict", str(wheel), str(archive)])
    print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, {archive.name}: twine finds nothing")
    return wheel, archive


def find_built() -> tuple[Path, Path]:
    """Return the wheel and the source archive in dist/."""
    wheels, archives = list(DIST.glob("*.whl")), list(DIST.glob("*.tar.gz"))
    if len(wheels) != 1 or len(archives) != 1:
        fail("dist/ does not hold one wheel and one source archive: leave --built out")
    return wheels[0], archives[0]


def check_contents(wheel: Path, archive: Path) -> None:
    """End where something is missing, is there though it should not, or links lead nowhere."""
    with zipfile.ZipFile(wheel) as file:
        names = file.namelist()
        (metadata,) = (name for name in names if name.endswith(".dist-info/METADATA"))
        readme = file.read(metadata).decode()
    if absent := [name for name in IN_THE_WHEEL if name not in names]:
        fail(f"the wheel lacks {', '.join(absent)}")
    if strange := [n for n in names if not re.match(r"deepdetect(/|-[\d.a-z]+\.dist-info/)", n)]:
        fail(f"the wheel holds {', '.join(strange[:5])}, which is none of the package's")
    if training := [name for name in names if re.search(NOT_IN_THE_WHEEL, name)]:
        fail(f"the wheel holds {', '.join(training)}, which only training reads: move it to lab/")
    if wheel.stat().st_size > MAX_WHEEL_BYTES:
        fail(f"the wheel takes {wheel.stat().st_size / 1e6:.0f} MB: something large got into it")
    if relative := re.findall(r"\]\((?!https?:|#|mailto:)([^)\s]+)\)", readme):
        fail(f"links of the README lead nowhere on an index: {', '.join(relative[:5])}")
    with tarfile.open(archive) as file:
        inside = {name.partition("/")[2].partition("/")[0] for name in file.getnames()}
    if absent := [name for name in IN_THE_ARCHIVE if name not in inside]:
        fail(f"the source archive lacks {', '.join(absent)}")


def find_python(name: str) -> str | None:
    """Return the path of a Python that can be started, or None."""
    path = shutil.which(name)
    if path is None:
        return None
    done = subprocess.run([path, "-c", "import venv, ensurepip"], capture_output=True)
    return path if done.returncode == 0 else None


def check_installs(python: str, wheel: Path, version: str) -> None:
    """Install the wheel without an index into an empty environment, and use it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fetched = folder / "fetched"
        own = make_environment(python, folder / "first")
        wanted = str(wheel)
        pip = [own, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        run([*pip, "download", "--only-binary", ":all:", "--dest", str(fetched), wanted])
        empty = make_environment(python, folder / "empty")
        install_offline(empty, fetched, f"deepdetect=={version}")
        use(empty, folder, version)


def check_archive_installs(python: str, archive: Path, version: str) -> None:
    """Build and install the source archive without an index, and use it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fetched = folder / "fetched"
        own = make_environment(python, folder / "first")
        pip = [own, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        needed = [str(archive), "hatchling>=1.27"]
        run([*pip, "download", "--dest", str(fetched), *needed])
        empty = make_environment(python, folder / "empty")
        install_offline(empty, fetched, f"deepdetect=={version}")
        use(empty, folder, version)


def make_environment(python: str, folder: Path) -> str:
    """Make an empty environment, and return its interpreter."""
    run([python, "-m", "venv", str(folder)])
    return str(folder / ("Scripts" if os.name == "nt" else "bin") / "python")


def install_offline(python: str, fetched: Path, wanted: str) -> None:
    """Install from a folder alone: not from another one that pip's settings name, either."""
    options = ["--isolated", "--quiet", "--disable-pip-version-check", "install", "--no-index"]
    run([python, "-m", "pip", *options, "--find-links", str(fetched), wanted])


def use(python: str, folder: Path, version: str) -> None:
    """Run the commands of an environment in a folder that knows nothing of the repository."""
    run([python, "-c", DRAW], folder)
    command = str(Path(python).with_name("deepdetect"))
    printed = run([command, "--version"], folder)
    if version not in printed:
        fail(f"the installed command prints {printed.strip()!r}, not version {version}")
    doctor = json.loads(run([command, "doctor", "--json"], folder))
    if not doctor["ok"]:
        fail("deepdetect doctor finds a problem in an empty environment")
    if str(ROOT) in doctor["findings"][0]["value"]:
        fail("the package was imported from the repository, and not from the wheel")
    found = json.loads(run([command, "detect", "picture.png", "--json"], folder))
    if not found["images"][0]["keypoints"] > 1000:
        fail("deepdetect detect finds next to nothing in an empty environment")


def run(words: list[str], folder: Path = ROOT) -> str:
    """Run a program without the settings of this one; end with what it says where it fails."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    done = subprocess.run(
        words,
        cwd=folder,
        env={name: value for name, value in os.environ.items() if name not in hidden},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        print(done.stdout + done.stderr, file=sys.stderr)
        fail(f"{' '.join(words[:6])} failed")
    return done.stdout


def fail(sentence: str) -> str:
    """End the program."""
    sys.exit(f"check_release: {sentence}")


if __name__ == "__main__":
    main()
