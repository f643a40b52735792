"""Fixtures that several test modules share."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import numpy as np
import pytest

# Some tests import ONNX Runtime by themselves.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

# The same examples on every run, no files left behind, no limit on time.
for _name, _examples in (("quick", 10), ("thorough", 60)):
    hypothesis.settings.register_profile(
        _name, deadline=None, derandomize=True, database=None, max_examples=_examples
    )


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that runs the slow tests, too."""
    parser.addoption("--runslow", action="store_true", help="run tests marked slow, too")


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker; draw more examples where time is no object."""
    config.addinivalue_line("markers", "slow: runs with --runslow only (`make test-all`)")
    hypothesis.settings.load_profile("thorough" if config.getoption("--runslow") else "quick")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # by a shell, for what runs behind it
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Skip the slow tests unless they are asked for."""
    if config.getoption("--runslow"):
        return
    skip = pytest.mark.skip(reason="slow: give --runslow")
    for item in items:
        if item.get_closest_marker("slow"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of photographs and reference data beside the repository."""
    folder = Path(__file__).parents[1] / "shared"
    if not folder.is_dir():
        pytest.skip("needs ../shared (photographs and reference data), which is not there")
    return folder


@pytest.fixture(scope="session")
def photo() -> np.ndarray:
    """A real photograph, (256, 256, 3) uint8 RGB, not to be written to."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    rgb = np.ascontiguousarray(data.astronaut()[::2, ::2])
    rgb.setflags(write=False)
    return rgb


@dataclass(frozen=True, eq=False)
class Facade:
    """Two views of a wall, 10 baselines away, and of a post before it at half that distance.

    `near` (H, W) bool is where the left view shows the post, `match` takes (N, 2) pixels of
    that view to their places in the right one.
    """

    left: np.ndarray
    right: np.ndarray
    near: np.ndarray
    camera: np.ndarray
    homographies: tuple[np.ndarray, np.ndarray]

    def match(self, pixels: np.ndarray) -> np.ndarray:
        import cv2

        on_wall, on_post = (
            cv2.perspectiveTransform(np.asarray(pixels, np.float64)[None], homography)[0]
            for homography in self.homographies
        )
        column, row = np.rint(pixels).astype(int).T
        return np.where(self.near[row, column][:, None], on_post, on_wall)


@pytest.fixture(scope="session")
def facade() -> Callable[[float], Facade]:
    """Draw a wall with a post that takes a share of the left view, of photographs."""
    import functools

    import cv2

    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    size, focal, wall_depth, post_depth, wall_width = (400, 300), 400.0, 10.0, 5.0, 16.0
    camera = np.array([[focal, 0, 199.5], [0, focal, 149.5], [0, 0, 1]])
    rotation = cv2.Rodrigues(np.radians([1.0, -3.0, 2.0]))[0]
    translation = -rotation @ [1.0, 0.06, 0.1]

    @functools.cache
    def draw(share: float) -> Facade:
        wall = cv2.resize(data.astronaut(), (1000, 700), interpolation=cv2.INTER_CUBIC)
        post = np.ascontiguousarray(data.coffee()[:, 100 : 100 + max(1, round(400 * share))])
        post_width = share * size[0] / focal * post_depth
        poses = (np.eye(3), np.zeros(3)), (rotation, translation)
        layers = (
            (wall, wall_depth, wall_width, 0.4),
            (post, post_depth, post_width, 1.0),
        )
        views = []
        for turn, move in poses:
            view = np.zeros((size[1], size[0], 3))
            for texture, depth, width, middle in layers:
                rows, columns = texture.shape[:2]
                scale = width / columns
                left, top = middle - width / 2, -scale * rows / 2
                plane = np.array([[scale, 0, left], [0, scale, top], [0, 0, depth]])
                seen = camera @ (turn @ plane + np.outer(move, [0, 0, 1]))
                opaque = np.full((rows, columns), 1, np.float32)
                mask = cv2.warpPerspective(opaque, seen, size)
                drawn = cv2.warpPerspective(texture, seen, size)
                view = view * (1 - mask[..., None]) + drawn * mask[..., None]
            views.append((view.round().astype(np.uint8), mask > 0.5))
        (left_view, near), (right_view, _) = views
        homographies = tuple(
            camera @ (rotation + np.outer(translation, [0, 0, 1 / depth])) @ np.linalg.inv(camera)
            for depth in (wall_depth, post_depth)
        )
        return Facade(left_view, right_view, near & (share > 0), camera, homographies)

    return draw


def _write_view(
    path: Path, source: np.ndarray, to_view: np.ndarray, size: tuple[int, int], light: float = 1
) -> None:
    import cv2
    from PIL import Image

    view = cv2.warpPerspective(source, to_view, size, flags=cv2.INTER_LINEAR)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(view * light).astype(np.uint8)).save(path)


@pytest.fixture(scope="session")
def write_scene() -> Callable[..., None]:
    """Write images 1 to `count` of a scene and the homographies between them."""
    data = pytest.importorskip("skimage.data", reason="needs scikit-image for its photographs")
    photograph = data.astronaut()

    def write(
        folder: Path,
        size: tuple[int, int],
        move: np.ndarray,
        names: tuple[str, str] = ("img{}.png", "H1to{}p"),
        count: int = 6,
        corner: tuple[int, int] = (150, 60),
        fading: float = 0.06,
    ) -> None:
        first = np.array([[1.0, 0, -corner[0]], [0, 1, -corner[1]], [0, 0, 1]])
        total = np.eye(3)
        for number in range(1, count + 1):
            light = 1 - fading * (number - 1)
            _write_view(folder / names[0].format(number), photograph, total @ first, size, light)
            if number > 1:
                np.savetxt(folder / names[1].format(number), total)
            total = move @ total

    return write


@pytest.fixture
def photo_path(photo: np.ndarray, tmp_path: Path) -> Path:
    """The photograph as a PNG file."""
    from PIL import Image

    path = tmp_path / "photo.png"
    Image.fromarray(photo).save(path)
    return path


@pytest.fixture(scope="session")
def one_line() -> Callable[[BaseException], str]:
    """Return an error's message, having checked that it is one line of text."""

    def check(error: BaseException) -> str:
        message = str(error)
        assert message.strip() == message
        assert message
        assert len(message.splitlines()) == 1, message
        return message

    return check


@pytest.fixture(scope="session")
def waves() -> Callable[[float, float], np.ndarray]:
    """Images (320, 320) uint8 of a sum of waves, exact wherever they are moved by (x, y) pixels."""
    rng = np.random.default_rng(0)
    frequencies, phases = rng.uniform(-0.9, 0.9, (60, 2)), rng.uniform(0, 2 * np.pi, 60)
    heights = 1 / (0.3 + np.linalg.norm(frequencies, axis=1))
    y, x = np.mgrid[:320, :320].astype(float)

    def moved(dx: float, dy: float) -> np.ndarray:
        parts = zip(frequencies, phases, heights, strict=True)
        total = sum(h * np.cos(f[0] * (x - dx) + f[1] * (y - dy) + p) for f, p, h in parts)
        return np.clip(np.rint(128 + 45 / np.sqrt((heights**2).sum() / 2) * total), 0, 255).astype(
            np.uint8
        )

    return moved
