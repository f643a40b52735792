"""What a method gives from many photographs, and how the cache holds it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...geometry.camera import Camera
from ...geometry.posed_view import PosedView
from ..metrics.multi_view import AGREEMENT_PX, CloudAgreement


@dataclass(frozen=True, eq=False)
class SfmModel:
    """A model of one kind of intrinsics.

    Attributes:
        views: the cameras by name; none where there is no model.
        points: number of sparse points.
        track_length: mean number of photographs that see one.
        error_px: mean reprojection error.
        seconds, cpu_seconds: of verification and mapping.
    """

    views: Mapping[str, PosedView]
    points: int
    track_length: float
    error_px: float
    seconds: float
    cpu_seconds: float


@dataclass(frozen=True, eq=False)
class SfmResult:
    """What a method gives.

    Attributes:
        keypoints: mean number in a photograph.
        matches: of all pairs together.
        seconds, cpu_seconds: of keypoints and matches.
        given, estimated: the models with the true intrinsics and with estimated ones.
        memory: bytes that the process held at most, before dense points are made.
        dense_points: number in each half of the photographs; 0 where there are none.
        dense_cpu_seconds: for both.
        dense_memory: bytes that the process held at most in the end.
        agreement: of the points of each half with those of the other.
    """

    keypoints: float
    matches: int
    seconds: float
    cpu_seconds: float
    given: SfmModel
    estimated: SfmModel
    memory: int
    dense_points: tuple[int, int] = (0, 0)
    dense_cpu_seconds: float = 0.0
    dense_memory: int = 0
    agreement: tuple[CloudAgreement, ...] = ()


def pack_result(result: SfmResult) -> dict[str, np.ndarray]:
    """Return a result as arrays by name, for the cache."""
    arrays: dict[str, np.ndarray] = {
        "numbers": np.array(
            [
                *(result.keypoints, result.matches, result.seconds, result.cpu_seconds),
                *(result.memory, *result.dense_points, result.dense_cpu_seconds),
                result.dense_memory,
            ],
            np.float64,
        ),
        "agreement": np.array(
            [
                [one.points, one.covered, one.median_px, one.median_depth_ratio, *one.within]
                for one in result.agreement
            ],
            np.float64,
        ).reshape(-1, 4 + len(AGREEMENT_PX)),
    }
    for kind in ("given", "estimated"):
        model: SfmModel = getattr(result, kind)
        views = list(model.views.values())
        arrays[f"{kind}_names"] = np.array([view.name for view in views], np.str_)
        arrays[f"{kind}_poses"] = np.array(
            [[*view.rotation.ravel(), *np.ravel(view.translation)] for view in views], np.float64
        ).reshape(-1, 12)
        arrays[f"{kind}_cameras"] = np.array(
            [[*v.camera.size, *v.camera.focal_px, *v.camera.centre] for v in views], np.float64
        ).reshape(-1, 6)
        arrays[f"{kind}_numbers"] = np.array(
            [model.points, model.track_length, model.error_px, model.seconds, model.cpu_seconds]
        )
    return arrays


def unpack_result(arrays: Mapping[str, np.ndarray]) -> SfmResult:
    """Return the result of `pack_result`."""
    keypoints, matches, seconds, cpu, memory, first, second, dense_cpu, dense_memory = arrays[
        "numbers"
    ].tolist()
    agreement = tuple(
        CloudAgreement(int(row[0]), row[1], row[2], row[3], tuple(row[4:]))
        for row in arrays["agreement"].tolist()
    )
    return SfmResult(
        keypoints,
        int(matches),
        seconds,
        cpu,
        _unpack_model(arrays, "given"),
        _unpack_model(arrays, "estimated"),
        int(memory),
        (int(first), int(second)),
        dense_cpu,
        int(dense_memory),
        agreement,
    )


def _unpack_model(arrays: Mapping[str, np.ndarray], kind: str) -> SfmModel:
    points, track_length, error_px, seconds, cpu_seconds = arrays[f"{kind}_numbers"].tolist()
    views = {}
    for name, pose, camera in zip(
        *(arrays[f"{kind}_{part}"] for part in ("names", "poses", "cameras")), strict=True
    ):
        width, height, fx, fy, cx, cy = camera.tolist()
        views[str(name)] = PosedView(
            str(name),
            Camera((int(width), int(height)), (fx, fy), (cx, cy)),
            pose[:9].reshape(3, 3),
            pose[9:],
        )
    return SfmModel(views, int(points), track_length, error_px, seconds, cpu_seconds)
