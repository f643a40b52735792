from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import deepdetect

ROOT = Path(deepdetect.__path__[0])
HEAVY = {"cv2", "matplotlib", "numba", "numpy", "onnxruntime", "openvino", "scipy", "torch"}


def in_a_fresh_interpreter(code: str) -> object:
    """Run code that prints JSON."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def test_every_public_name_can_be_imported() -> None:
    assert deepdetect.__all__ == sorted(deepdetect.__all__)
    assert set(deepdetect.__all__) <= set(dir(deepdetect))
    for name in deepdetect.__all__:
        assert getattr(deepdetect, name).__name__ == name
    assert deepdetect.__version__ == "1.0.0rc1"


@pytest.mark.parametrize(
    "package",
    ["detector", "features", "matching", "reconstruction", "sfm"],
)
def test_every_name_of_a_namespace_can_be_imported(package: str) -> None:
    if package == "training":
        pytest.importorskip("torch")
    code = (
        f"import json, deepdetect.{package} as names; "
        "print(json.dumps([str(getattr(names, name)) for name in names.__all__]))"
    )
    assert in_a_fresh_interpreter(code)


def test_the_stub_exports_what_it_imports() -> None:
    """In a stub only `from x import name as name` is an export, for type checkers."""
    tree = ast.parse((ROOT / "__init__.pyi").read_text("utf-8"))
    names = [
        alias for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names
    ]
    assert all(alias.asname == alias.name for alias in names)
    assert {alias.name for alias in names} == set(deepdetect.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="DeepDetekt"):
        deepdetect.DeepDetekt  # noqa: B018


def test_importing_does_no_work() -> None:
    code = (
        "import json, logging, sys, deepdetect;"
        "assert not logging.getLogger().handlers;"
        "print(json.dumps(sorted(sys.modules)))"
    )
    assert not HEAVY & set(in_a_fresh_interpreter(code))  # type: ignore[call-overload]


@pytest.mark.parametrize(
    "module",
    [
        "deepdetect.cli",
        "deepdetect_lab.labels",
        "deepdetect.detector.detector",
        "deepdetect.io.image",
    ],
)
def test_modules_import_no_heavy_package_that_they_may_not_need(module: str) -> None:
    code = f"import json, sys, {module}; print(json.dumps(sorted(sys.modules)))"
    loaded = set(in_a_fresh_interpreter(code))  # type: ignore[call-overload]
    assert not loaded & (HEAVY - {"cv2", "numpy"})


IMPORT_ALL = """
import gc, importlib, json, pkgutil
import numpy as np
import deepdetect
from deepdetect._shared import runtimes

started, large = [], {}
runtimes.start_session = lambda *given, **_: started.append(str(given))
def size(value):
    if isinstance(value, (dict, list, tuple)):
        return sum(map(size, value.values() if isinstance(value, dict) else value))
    return value.nbytes if isinstance(value, np.ndarray) else 0
for found in pkgutil.walk_packages(deepdetect.__path__, "deepdetect."):
    if not found.name.endswith("__main__"):
        try:
            module = importlib.import_module(found.name)
        except deepdetect.MissingExtraError:
            continue
        sizes = {f"{found.name}.{name}": size(value) for name, value in vars(module).items()}
        large |= {name: bytes_ for name, bytes_ in sizes.items() if bytes_ > 1000}
kinds = deepdetect.DeepDetect, deepdetect.PointDetector
made = [type(each).__name__ for each in gc.get_objects() if type(each) in kinds]
print(json.dumps([started, made, large]))
"""


def test_importing_all_modules_makes_no_detector_and_no_large_array() -> None:
    assert in_a_fresh_interpreter(IMPORT_ALL) == [[], [], {}]


def test_errors_are_named_by_where_users_import_them_from() -> None:
    for name in deepdetect.__all__:
        if name.endswith("Error"):
            assert getattr(deepdetect, name).__module__ == "deepdetect"
