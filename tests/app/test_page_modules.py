"""The page's own arithmetic, run by node, beside the package's: keypoints, reduction, luma."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import deepdetect
from deepdetect import SelectionOptions
from deepdetect.features import select_keypoints

OPTIONS = (
    {},
    {"threshold": 0.9},
    {"threshold": 0},
    {"threshold": 1},
    {"density": 0.1},
    {"density": 1},
    {"density": 1e-6},
)


def compare(run_node: Any, logits: np.ndarray) -> None:
    """Compare x, y and probability of the page's keypoints by all options with the package's."""
    from deepdetect.features.selection import sigmoid

    script = """
const map = prepare(new Float32Array(bytes), width, height);
const rows = values.options.flatMap((options) => Array.from(select(map, options), (pixel) =>
  [values.options.indexOf(options), pixel % width, Math.floor(pixel / width),
   map.probability[pixel]]));
writeFileSync(made, new Uint8Array(Float64Array.from(rows.flat()).buffer));
"""
    imports = 'import { prepare, select } from "@/selection.js";\n'
    chosen = [{"threshold": 0.5, "density": None, **options} for options in OPTIONS]
    height, width = logits.shape
    rows = run_node(imports, script, logits, width=width, height=height, options=chosen)
    rows = rows.reshape(-1, 4)
    for k, options in enumerate(OPTIONS):
        expected = select_keypoints(sigmoid(logits), SelectionOptions(**options), logits)
        found = rows[rows[:, 0] == k, 1:]
        np.testing.assert_array_equal(found[:, :2], expected.xy, err_msg=str(options))
        np.testing.assert_allclose(found[:, 2], expected.scores, atol=2e-7)


def test_the_keypoints_of_a_photograph(run_node: Any, photo: np.ndarray) -> None:
    compare(run_node, deepdetect.DeepDetect().heatmap_and_logits(photo)[1])


@pytest.mark.parametrize(("height", "width"), [(16, 16), (37, 50)])
def test_keypoints_among_many_equal_ranks(height: int, width: int, run_node: Any) -> None:
    """Plateaus: which of their pixels are taken is decided by the same order."""
    logits = np.random.default_rng(0).integers(-2, 3, (height, width)).astype(np.float32)
    compare(run_node, logits)


@pytest.mark.parametrize("size", [(250, 200), (131, 77)], ids=str)
def test_reduction_is_that_of_opencv(
    size: tuple[int, int], run_node: Any, photo: np.ndarray
) -> None:
    import cv2

    rgba = np.dstack([photo, np.full(photo.shape[:2], 255, np.uint8)])
    rgba = np.ascontiguousarray(np.tile(rgba, (2, 2, 1))[:401, :503])
    script = """
const rgba = new Uint8ClampedArray(bytes);
const rows = (top, count) => rgba.subarray(4 * top * width, 4 * (top + count) * width);
const small = reduceByArea(rows, width, height, ...values.size);
writeFileSync(made, new Uint8Array(Float64Array.from(small).buffer));
"""
    imports = 'import { reduceByArea } from "@/pixels.js";\n'
    found = run_node(imports, script, rgba, width=503, height=401, size=size)
    found = found.reshape(size[1], size[0], 4)[..., :3]
    expected = cv2.resize(rgba[..., :3], size, interpolation=cv2.INTER_AREA).astype(float)
    assert np.abs(found - expected).max() <= 1
    assert (found == expected).mean() > 0.999


@pytest.mark.parametrize("values", ["COLOUR", "GRAY"])
def test_reduction_to_half_is_that_of_opencv(values: str, run_node: Any, photo: np.ndarray) -> None:
    """For which OpenCV has code of its own, that rounds otherwise."""
    import cv2

    channels = 4 if values == "COLOUR" else 1
    given = np.tile(photo[:, :, :1], (2, 2, channels))[:200, :298].copy()
    script = f"""
const pixels = new Uint8ClampedArray(bytes);
const rows = (top, count) => pixels.subarray({channels} * width * top,
                                             {channels} * width * (top + count));
const small = reduceByArea(rows, width, height, width / 2, height / 2, {values});
writeFileSync(made, new Uint8Array(Float64Array.from(small).buffer));
"""
    imports = 'import { COLOUR, GRAY, reduceByArea } from "@/pixels.js";\n'
    found = run_node(imports, script, given, width=298, height=200).reshape(100, 149, channels)
    expected = cv2.resize(given, (149, 100), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(found[..., :3], np.atleast_3d(expected)[..., :3])


@pytest.mark.parametrize("size", [(1601, 1250), (1250, 1600), (2400, 1000), (5000, 500)], ids=str)
def test_large_photographs_are_reduced_to_the_size_that_the_package_takes(
    size: tuple[int, int], run_node: Any
) -> None:
    from deepdetect.detector.heatmap import compute_maps

    seen = []

    def network(planes: np.ndarray) -> np.ndarray:
        seen.append(planes.shape[:1:-1])
        return planes[:, :1]

    rgb = np.zeros((size[1], size[0], 3), np.uint8)
    rgb[0, 0] = 1
    compute_maps(rgb, network)
    imports = 'import { networkSize } from "@/pixels.js";\n'
    script = (
        "writeFileSync(made, new Uint8Array(Float64Array.from(networkSize(width, height)).buffer));"
    )
    found = run_node(imports, script, np.zeros(1), width=size[0], height=size[1])
    # What the page takes as it is, the network pads.
    assert [-(-side // 8) * 8 for side in found] == list(seen[0])


def test_luma(run_node: Any, photo: np.ndarray) -> None:
    from deepdetect.io.image import luma

    imports = 'import { luma } from "@/pixels.js";\n'
    script = """
const gray = luma(new Uint8Array(bytes));
writeFileSync(made, new Uint8Array(Float64Array.from(gray).buffer));
"""
    rgba = np.dstack([photo, np.full(photo.shape[:2], 255, np.uint8)])
    found = run_node(imports, script, rgba, width=0, height=0)
    np.testing.assert_array_equal(found.reshape(photo.shape[:2]), luma(photo))
