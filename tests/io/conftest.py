"""A real cloud: the left view of a Middlebury scene at its true disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deepdetect.geometry.point_cloud import PointCloud


@pytest.fixture(scope="session")
def cones(shared: Path) -> PointCloud:
    """About 160,000 points of cones, in baselines."""
    from deepdetect_lab.datasets.middlebury import load_middlebury

    scene = load_middlebury(shared / "data/middlebury/cones")
    known = np.isfinite(scene.disparity) & (scene.disparity > 0)
    y, x = np.nonzero(known)
    height, width = known.shape
    ray = np.column_stack([x - (width - 1) / 2, y - (height - 1) / 2, np.full(len(x), 360.0)])
    points = (ray / scene.disparity[known][:, None]).astype(np.float32)
    return PointCloud(points, scene.left[known], "baseline")


@pytest.fixture
def small() -> PointCloud:
    """256 points with every shade of grey among the colours, in millimetres."""
    rng = np.random.default_rng(3)
    points = rng.normal((10, -20, 900), (100, 80, 40), (256, 3))
    colors = rng.integers(0, 256, (256, 3)).astype(np.uint8)
    colors[:, 1] = np.arange(256)
    return PointCloud(points, colors, "mm")
