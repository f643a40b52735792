from __future__ import annotations

import ast
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

import deepdetect

PACKAGE = Path(deepdetect.__file__).parent
MODULE = """
from deepdetect._shared.kernels import compiled

@compiled(nogil=True)
def add(a, b):
    return a + b
"""
ADD = """
import numba
before = numba.config.CACHE_DIR
from kernel_of_test import add
assert numba.config.CACHE_DIR == before
assert add(1, 2) == 3
assert add.targetoptions["nogil"] and add.signatures
print(add.stats.cache_path, len(add.stats.cache_hits))
"""
needs_users = pytest.mark.skipif(
    not hasattr(os, "getuid"), reason="the temporary directory is not shared by users here"
)


@pytest.fixture
def sealed(tmp_path: Path) -> Path:
    """A folder in which numba can neither write beside a module nor in the home folder.

    Files in the places of the folders, so that they cannot be made by the superuser either.
    """
    folder = tmp_path / "sealed"
    folder.mkdir()
    (folder / "kernel_of_test.py").write_text(MODULE)
    (folder / "__pycache__").touch()
    (tmp_path / "home").touch()
    (tmp_path / "temporary").mkdir()
    return folder


def run(code: str, sealed: Path, **variables: object) -> str:
    """Run Python in a fresh process without a home, and return its output."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name != "XDG_CACHE_HOME" and not name.startswith("NUMBA_")
    }
    home = str(sealed.parent / "home")
    own = {
        **dict.fromkeys(("HOME", "USERPROFILE", "LOCALAPPDATA"), home),
        "TMPDIR": sealed.parent / "temporary",
        "PYTHONPATH": f"{PACKAGE.parent}{os.pathsep}{sealed}",
    }
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=kept | {name: str(value) for name, value in (own | variables).items()},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def temporary_folder(sealed: Path) -> Path:
    return sealed.parent / "temporary" / f"deepdetect-numba-{os.getuid()}"


@needs_users
@pytest.mark.slow
def test_the_cache_in_the_temporary_directory(sealed: Path) -> None:
    folder = temporary_folder(sealed)
    for hits in "01":
        path, seen = run(ADD, sealed).split()
        assert seen == hits
        assert Path(path).parent == folder
        assert len(list(folder.rglob("*.nbc"))) == 1
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.slow
@needs_users
@pytest.mark.parametrize("kind", ["file", "link", "open to others"])
def test_a_folder_that_another_user_may_have_made_is_not_taken(kind: str, sealed: Path) -> None:
    folder, other = temporary_folder(sealed), sealed.parent / "other"
    other.mkdir(mode=0o700)
    if kind == "file":
        folder.touch()
    elif kind == "link":
        folder.symlink_to(other)
    else:
        folder.mkdir()
        folder.chmod(0o770)
    assert run(ADD, sealed) == "None 0"
    assert list(other.iterdir()) == []
    assert kind == "file" or list(folder.iterdir()) == []


def test_the_cache_beside_the_module(sealed: Path) -> None:
    (sealed / "__pycache__").unlink()
    path, _ = run(ADD, sealed).split()
    assert Path(path) == sealed / "__pycache__"
    assert list(Path(path).glob("*.nbi"))


def test_the_first_compilation_is_announced_once(sealed: Path) -> None:
    code = (
        "from deepdetect._shared import kernels\n"
        "kernels.announce_compilation(lambda: print('compiling'))\n"
        "from kernel_of_test import add\n"
        "print('imported')\n"
        "print(add(1, 2), add(1.5, 2))\n"
    )
    cache = sealed.parent / "cache"
    assert run(code, sealed, NUMBA_CACHE_DIR=cache).split() == ["imported", "compiling", "3", "3.5"]
    assert run(code, sealed, NUMBA_CACHE_DIR=cache).split() == ["imported", "3", "3.5"]


def test_kernels_do_without_linear_algebra() -> None:
    """Numba takes it from scipy, which a plain installation has not."""
    counted = 0
    for path in PACKAGE.rglob("*.py"):
        if "@compiled(" not in (source := path.read_text(encoding="utf-8")):
            continue
        functions = [each for each in ast.parse(source).body if isinstance(each, ast.FunctionDef)]
        for function in functions:
            if not any("compiled(" in ast.unparse(each) for each in function.decorator_list):
                continue
            counted += 1
            for node in ast.walk(function):
                assert not isinstance(node, ast.MatMult), function.name
                name = getattr(node, "attr", None)
                assert name not in ("dot", "vdot", "linalg", "outer", "kron"), function.name
    assert counted > 20
