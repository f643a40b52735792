from __future__ import annotations

import dataclasses
import importlib
import inspect
import subprocess
import sys

import pytest

import deepdetect


def test_all_is_sorted_and_complete() -> None:
    assert deepdetect.__all__ == sorted(deepdetect.__all__)
    assert set(deepdetect.__all__) == set(deepdetect._HOMES) | {"__version__"}
    for name in deepdetect.__all__:
        assert getattr(deepdetect, name) is not None


@pytest.mark.parametrize("name", sorted(set(deepdetect.__all__) - {"__version__"}))
def test_every_public_name_is_documented(name: str) -> None:
    documented = inspect.getdoc(getattr(deepdetect, name))
    assert documented
    assert len(documented) > 30


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'DeepDetekt'"):
        deepdetect.DeepDetekt  # noqa: B018


def test_importing_does_no_work() -> None:
    code = (
        "import sys, logging, deepdetect;"
        "assert not logging.getLogger().handlers;"
        "print(sorted({'numpy', 'cv2', 'torch', 'onnxruntime'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "name", [n for n in deepdetect.__all__ if n.endswith("Options") or n in ("Matches", "Label")]
)
def test_options_and_results_are_frozen_dataclasses(name: str) -> None:
    kind = getattr(deepdetect, name)
    assert dataclasses.is_dataclass(kind)
    assert kind.__dataclass_params__.frozen


def test_imports_run_one_way() -> None:
    """The command line sits on top: nothing below imports it."""
    import pkgutil
    from pathlib import Path

    root = Path(deepdetect.__path__[0])
    for module in pkgutil.walk_packages(deepdetect.__path__, "deepdetect."):
        path = root.joinpath(*module.name.split(".")[1:])
        source = (path / "__init__.py" if module.ispkg else path.with_suffix(".py")).read_text()
        if not module.name.startswith(("deepdetect.cli", "deepdetect.__main__")):
            assert "cli import" not in source, module.name
        if module.name.startswith(("deepdetect.labels", "deepdetect.geometry")):
            assert "training import" not in source, module.name


def test_module_sizes_stay_readable() -> None:
    from pathlib import Path

    for path in Path(deepdetect.__path__[0]).rglob("*.py"):
        assert len(path.read_text().splitlines()) <= 400, path


@pytest.mark.parametrize(
    "registry", ["labels.registry", "descriptors.registry", "matchers.registry", "runtime.registry"]
)
def test_registries_import_without_heavy_packages(registry: str) -> None:
    importlib.import_module(f"deepdetect.{registry}")
