from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from tests.command_line import Result, run_command


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Result]:
    """Run `deepdetect` with arguments, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def invoke(*arguments: object) -> Result:
        return run_command([str(argument) for argument in arguments])

    return invoke


@pytest.fixture(scope="session")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two views of one scene and a third photograph."""
    from PIL import Image
    from skimage import data

    folder = tmp_path_factory.mktemp("photos")
    left, right, _ = data.stereo_motorcycle()
    for name, image in (("left", left), ("right", right)):
        Image.fromarray(image[100:260, 300:500]).save(folder / f"{name}.png")
    Image.fromarray(data.chelsea()[:150, :200]).save(folder / "cat.jpg")
    return folder


def one_sentence(output: str) -> bool:
    """Tell whether an error is one short line without a traceback."""
    lines: Sequence[str] = [line for line in output.strip().splitlines() if line]
    return len(lines) == 1 and "Traceback" not in output and len(output) < 400
