"""The path of a car from the video of one camera: DeepDetect beside SIFT and ORB.

    python examples/visual_odometry ../shared/data/kitti-clip -o odometry/

The folder holds frames, calib.txt and poses.txt as KITTI's odometry benchmark has them. All methods
go the same road: keypoints followed by Lucas-Kanade, then `odometry`. The truth is used for one
number, the scale, and to measure the errors.
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

from deepdetect import Camera, DeepDetectError, Keypoints, load_image
from deepdetect.geometry.relative_pose import rotation_angle
from deepdetect.io.image import find_images, luma
from deepdetect.tracking import Tracker, TrackingOptions, point_candidates
from deepdetect.tracking.tracker import CANDIDATES

SEGMENTS_M = (10.0, 20.0, 30.0, 40.0, 50.0)  # KITTI's own, 100 to 800 m, are longer than a clip
COLORS = {"DeepDetect": "C0", "SIFT": "C1", "ORB": "C2"}
HEADER = "method               frames    end %    mean %   end °/m  segments % seg. °/m CPU s  wall"


def methods(count: int) -> dict[str, Callable[[np.ndarray], Keypoints]]:
    """Return what finds keypoints of an RGB image, by name."""
    options = TrackingOptions(max_keypoints=count)
    sift, orb = (make(CANDIDATES * count) for make in (cv2.SIFT_create, cv2.ORB_create))

    def opencv(feature: cv2.Feature2D, rgb: np.ndarray) -> Keypoints:
        points = feature.detect(luma(rgb), None)
        return Keypoints.from_opencv(points, (rgb.shape[1], rgb.shape[0]))

    return {
        "DeepDetect": point_candidates(options),
        "SIFT": partial(opencv, sift),
        "ORB": partial(opencv, orb),
    }


def read_matrices(path: Path, count: int | None = None) -> np.ndarray:
    """Return the first (N, 3, 4) matrices in a file of KITTI's, which may name them before a colon.

    Raises:
        DeepDetectError: it is missing, is another, or has fewer.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()[:count]
        values = np.array([line.split(":")[-1].split() for line in lines], float)
        matrices = values.reshape(-1, 3, 4)
    except OSError:
        raise DeepDetectError(
            f"there is no file {path}: give a folder with frames, calib.txt and poses.txt as KITTI "
            "has them"
        ) from None
    except ValueError:
        raise DeepDetectError(f"{path} must have twelve numbers on each line") from None
    if len(matrices) < (count or 0):
        raise DeepDetectError(f"{path} has {len(matrices)} lines, fewer than the {count} frames")
    return matrices


def trajectory_errors(poses: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """Compare a path with the true one, after both begin in one pose and have one scale.

    The scale, which one camera cannot know, is the one with the least squared distances of all
    positions. Segments are measured as by Geiger et al., "Are we ready for autonomous driving? The
    KITTI vision benchmark suite", 2012.

    Args:
        poses, truth: (F, 3, 4), camera to world.

    Returns:
        Errors of the last and of all positions in per cent of the path; of the last rotation in
        degrees per metre; of the motion and of the rotation along all segments; and the (F, 3)
        aligned positions.
    """
    start = truth[0, :, :3] @ poses[0, :, :3].T
    turns, true_turns = start @ poses[..., :3], truth[..., :3]
    moved, true = ((each[..., 3] - each[0, :, 3]) for each in (poses, truth))
    moved = moved @ start.T
    # Below 0 it would turn a path that goes the wrong way into a right one.
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


def plot(paths: dict[str, np.ndarray], truth: np.ndarray, file: Path) -> None:
    """Draw trajectories from above and from the side against the truth."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots(2, 1, sharex=True)
    for axis, row, label in zip(axes, (0, 1), ("right, m", "down, m"), strict=True):
        axis.plot(truth[:, 2], truth[:, row], "k--", label="truth")
        for name, centres in paths.items():
            axis.plot(centres[:, 2], centres[:, row], color=COLORS[name], label=name)
        axis.set_ylabel(label)
        axis.grid(alpha=0.3)
    axes[0].legend()
    axes[1].set_xlabel("forward, m (other scale than across)")
    figure.savefig(file, dpi=110)


def compare(arguments: argparse.Namespace) -> None:
    """Run all methods, print a table, and write poses and the plot."""
    last = None if arguments.frames is None else arguments.first + arguments.frames
    paths = find_images(arguments.folder)[arguments.first : last]
    if len(paths) < 2:
        raise DeepDetectError(f"there are not two frames from number {arguments.first} on")
    matrix = read_matrices(arguments.folder / "calib.txt", 1)[0]
    truth = read_matrices(arguments.folder / "poses.txt", arguments.first + len(paths))
    truth = truth[arguments.first :]
    height, width = load_image(paths[0]).shape[:2]
    camera = Camera((width, height), (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))
    arguments.output.mkdir(parents=True, exist_ok=True)
    numbers, shown = {}, {}
    print(f"{len(paths)} frames\n{HEADER}")
    for name, detect in methods(arguments.max_keypoints).items():
        if name not in arguments.methods:
            continue
        odometry = VisualOdometry(camera)
        tracker = Tracker(detect, TrackingOptions(max_keypoints=arguments.max_keypoints))
        wall, cpu = time.perf_counter(), time.process_time()
        for path in paths:
            odometry.update(tracker.update(load_image(path)))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        frames, poses = odometry.trajectory()
        if len(frames) < 2:
            print(f"{name:20} no path was found")
            continue
        errors = trajectory_errors(poses, truth[frames])
        centres = errors.pop("centres")
        errors |= {"cpu_s_per_frame": cpu / len(paths), "wall_s_per_frame": wall / len(paths)}
        columns = " ".join(f"{value:9.4f}" for value in errors.values() if value is not None)
        print(f"{name:20} {len(frames):6} {columns}", flush=True)
        numbers[name] = {"frames": len(frames), **errors}
        file = arguments.output / f"{name.lower()}.txt"
        np.savetxt(file, poses.reshape(-1, 12), fmt="%.9e")  # KITTI's format
        shown[name] = centres
    plot(shown, truth[..., 3], arguments.output / "trajectory.jpg")
    (arguments.output / "errors.json").write_text(json.dumps(numbers, indent=2), encoding="utf-8")


def main() -> None:
    """Read the words of the command line; what is wrong ends it with a sentence."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("odometry"))
    parser.add_argument("--max-keypoints", type=int, default=TrackingOptions.max_keypoints)
    parser.add_argument("--first", type=int, default=0, help="first frame")
    parser.add_argument("--frames", type=int, help="how many  [default: all]")
    parser.add_argument("--methods", nargs="+", choices=COLORS, default=COLORS, help="some of them")
    try:
        compare(parser.parse_args())
    except DeepDetectError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")


if __name__ == "__main__":
    main()
