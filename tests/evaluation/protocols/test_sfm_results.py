from __future__ import annotations

import numpy as np

from deepdetect.evaluation.metrics.multi_view import CloudAgreement
from deepdetect.evaluation.protocols.sfm_results import (
    SfmModel,
    SfmResult,
    pack_result,
    unpack_result,
)
from deepdetect.geometry.camera import Camera
from deepdetect.geometry.posed_view import PosedView


def test_a_result_survives_the_cache() -> None:
    camera = Camera((64, 48), (50.0, 51.0), (30.0, 20.0))
    view = PosedView("a b.jpg", camera, np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0]))
    model = SfmModel({view.name: view}, 7, 2.5, 0.25, 4.0, 8.0)
    nothing = SfmModel({}, 0, float("nan"), float("nan"), 1.0, 1.0)
    agreement = CloudAgreement(5, 0.5, 0.1, 0.001, (0.1, 0.2, 0.3, 0.4, 0.5))
    result = SfmResult(100.5, 9, 1.0, 2.0, model, nothing, 10, (3, 4), 5.0, 12, (agreement,))
    read = unpack_result(pack_result(result))
    assert (read.keypoints, read.matches, read.memory, read.dense_memory) == (100.5, 9, 10, 12)
    assert (read.seconds, read.cpu_seconds, read.dense_cpu_seconds) == (1, 2, 5)
    assert read.dense_points == (3, 4)
    assert read.agreement == (agreement,)
    assert read.estimated.views == {}
    assert np.isnan(read.estimated.error_px)
    again = read.given.views["a b.jpg"]
    assert again.camera == camera
    np.testing.assert_array_equal(again.rotation, view.rotation)
    np.testing.assert_array_equal(again.translation, view.translation)
    assert (read.given.points, read.given.track_length, read.given.error_px) == (7, 2.5, 0.25)
    assert (read.given.seconds, read.given.cpu_seconds) == (4, 8)
