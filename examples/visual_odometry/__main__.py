"""Visual odometry of a car with one camera: DeepDetect compared with SIFT and ORB.

    python examples/visual_odometry ../shared/data/kitti-clip -o odometry/

The folder contains frames, calib.txt or K.txt, and poses.txt, as in KITTI's odometry benchmark. All
keypoints are processed alike: they are tracked by Lucas-Kanade or matched by descriptors (learned
ones for DeepDetect, RootSIFT for SIFT), then used by `odometry`. Ground truth determines one
number, the scale of each path, and measures the errors. Errors of a path vary by several per cent
with the number of keypoints, so methods are compared by their means over several numbers.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from odometry import VisualOdometry

from deepdetect import (
    DeepDetectError,
    Keypoints,
    PointDetector,
    load_image,
    match_features,
)
from deepdetect.features.sift import describe_keypoints
from deepdetect.geometry.relative_pose import rotation_angle
from deepdetect.io.image import luma
from deepdetect.tracking import TrackedFrame, Tracker, TrackingOptions, point_candidates
from deepdetect.tracking.tracker import CANDIDATES
from deepdetect_lab.datasets.posed_images import load_posed_scenes

NUMBERS = (250, 500, 1000)  # default numbers of keypoints
SEGMENTS_M = (10.0, 20.0, 30.0, 40.0, 50.0)  # KITTI's segments, 100 to 800 m, exceed a clip
FEATURES = ("DeepDetect", "SIFT", "ORB")
HEADER = "    end %    mean %   end °/m    seg. %  seg. °/m     CPU s"


def trackers(count: int) -> dict[str, Tracker | Matcher]:
    """Return the trackers and matchers of keypoints, by name."""
    options = TrackingOptions(max_keypoints=count)
    sift, orb = (make(CANDIDATES * count) for make in (cv2.SIFT_create, cv2.ORB_create))

    def opencv(feature: cv2.Feature2D, rgb: np.ndarray) -> Keypoints:
        points = feature.detect(luma(rgb), None)
        return Keypoints.from_opencv(points, (rgb.shape[1], rgb.shape[0]))

    detectors = {
        "DeepDetect": point_candidates(options),
        "SIFT": partial(opencv, sift),
        "ORB": partial(opencv, orb),
    }
    followed = {name: Tracker(detect, options) for name, detect in detectors.items()}
    describe = {
        "DeepDetect": PointDetector().describe,
        "SIFT": lambda rgb, points: describe_keypoints(luma(rgb), points),
    }
    matched = {f"{name}, matched": Matcher(detectors[name], describe[name]) for name in describe}
    return followed | matched


class Matcher:
    """A tracker that matches the descriptors of successive frames."""

    def __init__(
        self,
        detect: Callable[[np.ndarray], Keypoints],
        describe: Callable[[np.ndarray, Keypoints], Keypoints],
    ) -> None:
        self.detect, self.describe = detect, describe
        self.before: Keypoints | None = None
        self.tracks, self.next_track, self.number = np.empty(0, np.int64), 0, 0

    def update(self, rgb: np.ndarray) -> TrackedFrame:
        """Match the keypoints of the next frame with those of the previous frame."""
        found = self.describe(rgb, self.detect(rgb))
        tracks = np.arange(len(found)) + self.next_track
        self.next_track += len(found)
        if self.before is not None:
            matches = match_features(self.before, found)
            tracks[matches.indices1] = self.tracks[matches.indices0]
        self.before, self.tracks, self.number = found, tracks, self.number + 1
        order = np.argsort(tracks)
        ages = np.zeros(len(order), np.int64)  # odometry does not use ages
        xy, scores = found.xy[order], found.scores[order]
        return TrackedFrame(self.number - 1, tracks[order], xy, scores, ages)


def trajectory_errors(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Compare a path with ground truth, after the alignment of the first pose and the scale.

    The scale, which one camera cannot know, minimises the squared distances of all positions.
    Segments are measured as in Geiger et al., "Are we ready for autonomous driving? The KITTI
    vision benchmark suite", 2012.

    Args:
        poses, truth: (F, 3, 4), camera to world.

    Returns:
        Errors of the last position and of all positions in per cent of the path, of the last
        rotation in degrees per metre, of translation and rotation along all segments, and the
        (F, 3) aligned positions.
    """
    start = truth[0, :, :3] @ poses[0, :, :3].T
    turns, true_turns = start @ poses[..., :3], truth[..., :3]
    moved, true = ((each[..., 3] - each[0, :, 3]) for each in (poses, truth))
    moved = moved @ start.T
    # A negative scale would make a path in the wrong direction look correct.
    moved *= max(0.0, (moved * true).sum() / (moved**2).sum())
    along = np.append(0.0, np.linalg.norm(np.diff(true, axis=0), axis=1).cumsum())
    moves, rotations = [], []
    for first in range(len(true)):
        for length in SEGMENTS_M:
            last = int(np.searchsorted(along, along[first] + length))
            if last == len(along):
                continue
            own, its = turns[first].T, true_turns[first].T
            difference = own @ (moved[last] - moved[first]) - its @ (true[last] - true[first])
            moves.append(100 * np.linalg.norm(difference) / length)
            angle = rotation_angle((its @ true_turns[last]).T @ own @ turns[last])
            rotations.append(angle / length)
    distances = 100 * np.linalg.norm(moved - true, axis=1) / along[-1]
    return {
        "end_percent": float(distances[-1]),
        "mean_percent": float(distances[1:].mean()),
        "end_deg_per_m": rotation_angle(true_turns[-1].T @ turns[-1]) / along[-1],
        "segment_percent": float(np.mean(moves)) if moves else None,
        "segment_deg_per_m": float(np.mean(rotations)) if moves else None,
        "centres": moved + truth[0, :, 3],
    }


def print_row(name: str, values: list[float]) -> None:
    """Print a row of the table."""
    columns = ("        -" if np.isnan(value) else f"{value:9.4f}" for value in values)
    print(f"{name:30} {' '.join(columns)}", flush=True)


def plot(paths: dict[str, np.ndarray], truth: np.ndarray, file: Path) -> None:
    """Plot trajectories and ground truth from above."""
    figure = Figure(figsize=(8, 4), layout="constrained")
    axis = figure.subplots()
    axis.plot(truth[:, 2], truth[:, 0], "k--", label="ground truth")
    for name, centres in paths.items():
        axis.plot(centres[:, 2], centres[:, 0], label=name)
    axis.set(xlabel="forward, m (other scale than across)", ylabel="right, m")
    axis.legend()
    figure.savefig(file, dpi=110)


def compare(arguments: argparse.Namespace) -> None:
    """Run all methods, print a table, and write poses and the plot."""
    images = load_posed_scenes(arguments.folder)[0].images
    turns = [image.rotation.T for image in images]
    centres = [-turn @ i.translation for turn, i in zip(turns, images, strict=True)]
    truth = np.dstack([turns, centres])
    arguments.output.mkdir(parents=True, exist_ok=True)
    numbers, shown = {}, {}
    print(f"{len(images)} frames\n{'method and frames':30} {HEADER}")
    methods = {
        (name, count): tracker
        for count in arguments.max_keypoints
        for name, tracker in trackers(count).items()
        if name.partition(",")[0] in arguments.methods
    }
    whole: dict[str, list[list[float]]] = {}
    for (method, count), tracker in methods.items():
        name = f"{method}, {count}"
        odometry = VisualOdometry(images[0].camera)
        begun = time.process_time()
        for image in images:
            odometry.update(tracker.update(load_image(image.path)))
        seconds = (time.process_time() - begun) / len(images)
        numbers[name] = {"cpu_s_per_frame": seconds, "lost": odometry.lost, "paths": (paths := [])}
        for frames, poses in odometry.trajectories():
            errors = trajectory_errors(poses, truth[frames])
            path = f"{name} {frames[0]}-{frames[-1]}"
            centres = errors.pop("centres")
            if count == arguments.max_keypoints[-1]:
                shown[path] = centres
            paths.append({"first": int(frames[0]), "frames": len(frames), **errors})
            values = [np.nan if e is None else e for e in errors.values()] + [seconds]
            print_row(path, values)
            if len(frames) == len(images):
                whole.setdefault(method, []).append(values)
            poses = poses.reshape(-1, 12)  # KITTI's format
            np.savetxt(arguments.output / f"{path.lower()}.txt", poses, fmt="%.9e")
        for frame in odometry.lost:
            print(f"{name} was LOST at frame {frame}: the path after it has another scale")
        if not paths:
            print(f"{name}: no path was found")
    for method, rows in whole.items():
        if len(rows) == len(arguments.max_keypoints) > 1:
            print_row(f"{method}, mean", np.mean(rows, axis=0).tolist())
    plot(shown, truth[..., 3], arguments.output / "trajectory.jpg")
    (arguments.output / "errors.json").write_text(json.dumps(numbers, indent=2), encoding="utf-8")


def main() -> None:
    """Parse the command line and run the comparison; report errors in one sentence."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("odometry"))
    parser.add_argument("--max-keypoints", type=int, nargs="+", default=NUMBERS)
    parser.add_argument("--methods", nargs="+", choices=FEATURES, default=FEATURES)
    try:
        compare(parser.parse_args())
    except DeepDetectError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")


if __name__ == "__main__":
    main()
