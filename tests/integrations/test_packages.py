from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable

import pytest

from deepdetect import MissingExtraError
from deepdetect._shared.errors import install_command
from deepdetect.integrations.packages import base_class, import_package

# Without any of the packages, as where nothing but deepdetect is installed.
WITHOUT = """
import importlib.util, json, sys
find = importlib.util.find_spec
HIDDEN = {"hloc", "kornia", "skimage", "torch", "transformers", "vismatch"}
importlib.util.find_spec = lambda name, *rest: None if name in HIDDEN else find(name, *rest)
for name in HIDDEN:
    sys.modules[name] = None
from deepdetect import MissingExtraError
from deepdetect.integrations import hloc, kornia, lightglue, opencv, skimage, transformers, vismatch
from deepdetect.features.keypoints import Keypoints
points = Keypoints.empty((9, 9))
calls = {
    "kornia": lambda: kornia.DeepDetectDetector(),
    "LightGlue": lambda: lightglue.DeepDetectExtractor(),
    "hloc": hloc.register,
    "an hloc model": lambda: hloc.DeepDetectExtractor({}),
    "vismatch": lambda: vismatch.DeepDetectMatcher(),
    "transformers": lambda: transformers.DeepDetectForKeypointDetection.from_deepdetect(),
    "from_pretrained": lambda: transformers.DeepDetectForKeypointDetection.from_pretrained("x"),
    "the processor": lambda: transformers.DeepDetectImageProcessor(),
    "register": transformers.register,
}
said = {}
for name, call in calls.items():
    try:
        call()
    except MissingExtraError as error:
        said[name] = str(error)
opencv.DeepDetectFeature2D(), skimage.DeepDetectFeatures()
print(json.dumps(said))
"""


def test_without_the_packages_each_drop_in_says_what_to_install() -> None:
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = json.loads(done.stdout)
    assert len(said) == 9
    needed = {
        "kornia": "torch",
        "LightGlue": "torch",
        "hloc": "git+https://github.com/cvg/Hierarchical-Localization",
        "an hloc model": "git+https://github.com/cvg/Hierarchical-Localization",
        "vismatch": "vismatch",
    }
    for name, message in said.items():
        package = needed.get(name, "transformers")
        assert f"run pip install {package}" in message
        assert message.endswith(f"run {install_command(package)}")
        assert len(message.splitlines()) == 1


def test_classes_derived_from_a_missing_one(one_line: Callable[[BaseException], str]) -> None:
    class Derived(base_class("no_such_package.models", "Model")):  # type: ignore[misc]
        """A class that can be defined, and not used."""

    assert Derived.__name__ == "Derived"
    assert not hasattr(Derived, "_private")
    for use in (Derived, lambda: Derived(1, b=2), lambda: Derived.from_pretrained):
        with pytest.raises(MissingExtraError) as caught:
            use()
        assert "run pip install no_such_package" in one_line(caught.value)
    with pytest.raises(MissingExtraError):
        import_package("no_such_package.models")
