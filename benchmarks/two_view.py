"""Print how true poses, sub-pixel matches and depths of unrectified pairs are.

    python benchmarks/two_view.py

The Motorcycle pair of Middlebury 2014 (in scikit-image's wheel), its views turned by known
rotations, so that the pose and every depth are known. Matches from rectification are sub-pixel
positions and are taken as they are, with corners among them refined for the pose; beside them stand
the same, rounded to whole pixels, and those aligned again, as other matches are. Beside the error
of the rotation, that without the refinement of the pose (degrees). The truth itself is off: by the
matches the rows of the pair are up to 0.1 px apart.
"""

from __future__ import annotations

import cv2
import numpy as np

from deepdetect import DeepDetect, match_images
from deepdetect.datasets import load_stereo_pair
from deepdetect.geometry.camera import Calibration, Camera
from deepdetect.geometry.relative_pose import estimate_relative_pose, rotation_angle
from deepdetect.io.image import luma
from deepdetect.reconstruction.subpixel import refine_matches
from deepdetect.reconstruction.two_view import TwoViewOptions, reconstruct_two_view

FOCAL, CENTRE, OFFSET = 994.978, (311.193, 254.877), 31.086
"""In pixels, of the page of skimage.data.stereo_motorcycle."""

TURNS = {
    "as it is": ((0, 0, 0), (0, 0, 0)),
    "5 degrees": ((0, 0, 0), (2, -3, 4)),
    "14 degrees": ((1, 2, -3), (4, -6, 8)),
}
"""Rotations of the left and of the right camera, degrees about x, y and z."""


def main() -> None:
    """Measure and print."""
    pair = load_stereo_pair("motorcycle")
    size = pair.left.shape[1::-1]
    left = Camera(size, FOCAL, CENTRE)
    right = Camera(size, FOCAL, (CENTRE[0] + OFFSET, CENTRE[1]))
    detector = DeepDetect("dense")
    print(
        "| turned | matches | positions | used | < 0.25 px | < 0.5 px | < 1 px | rotation | "
        "not refined | direction | points | depth within 1 % | 2 % | 5 % | seconds |\n"
        + "|---" * 15
        + "|"
    )
    for name, degrees in TURNS.items():
        turns = [cv2.Rodrigues(np.radians(np.array(angles, float)))[0] for angles in degrees]
        maps = [
            camera.matrix @ turn @ np.linalg.inv(camera.matrix)
            for camera, turn in zip((left, right), turns, strict=True)
        ]
        views = [
            cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_LANCZOS4)
            for image, matrix in zip((pair.left, pair.right), maps, strict=True)
        ]
        grays = tuple(luma(view) for view in views)
        found = match_images(*views, detector)
        points0 = found.points0
        # The truth is read at the nearest pixel of the view that was not turned.
        back = cv2.perspectiveTransform(points0[None].astype(float), np.linalg.inv(maps[0]))[0]
        column, row = np.clip(np.rint(back), 0, np.array(size) - 1).astype(int).T
        disparity = pair.disparity[row, column].astype(float)
        known = np.isfinite(disparity)
        there = np.column_stack([back[:, 0] - np.where(known, disparity, 0), back[:, 1]])
        there = cv2.perspectiveTransform(there[None], maps[1])[0]
        depth = ((left.rays(back) * (FOCAL / (disparity + OFFSET))[:, None]) @ turns[0].T)[:, 2]
        calibration = Calibration(left, right, source="the page")
        rotation, translation = turns[1] @ turns[0].T, -turns[1][:, 0]
        whole = np.rint(found.points1)
        aligned = refine_matches(*grays, points0, whole)
        everything = np.ones(len(points0), bool)
        for label, points1, used, subpixel in (
            ("as matched", found.points1.astype(float), everything, True),
            ("whole pixels", whole, everything, None),
            ("whole pixels, aligned", aligned.points1, aligned.converged, False),
        ):
            rows = np.flatnonzero(used)
            error = np.linalg.norm(points1 - there, axis=1)[used & known]
            model = reconstruct_two_view(
                points0[rows],
                (whole if subpixel is False else points1)[rows],
                calibration,
                grays,
                TwoViewOptions() if subpixel is not None else TwoViewOptions(subpixel=None),
                refined=bool(subpixel),
            )
            pose = model.pose
            off = np.abs(model.points[:, 2] / depth[rows[model.indices]] - 1)
            off = off[np.isfinite(off)]
            across = np.linalg.norm(np.cross(pose.translation, translation))
            direction = np.degrees(np.arctan2(across, pose.translation @ translation))
            rough = estimate_relative_pose(points0[rows], points1[rows], calibration, refine=False)
            assert rough is not None
            print(
                f"| {name} | {len(points0):,} | {label} | {used.mean():.1%} | "
                + " | ".join(f"{(error < limit).mean():.1%}" for limit in (0.25, 0.5, 1))
                + f" | {rotation_angle(pose.rotation @ rotation.T):.3f} | "
                + f"{rotation_angle(rough.rotation @ rotation.T):.3f} | {direction:.2f} | "
                + f"{len(model):,} | "
                + " | ".join(f"{(off < limit).mean():.1%}" for limit in (0.01, 0.02, 0.05))
                + f" | {sum(model.seconds.values()):.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
