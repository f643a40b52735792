"""The path of a car from the video of one camera: DeepDetect beside SIFT and ORB.

    python examples/visual_odometry.py ../shared/data/kitti-clip -o odometry/

The folder holds frames, calib.txt and poses.txt as KITTI's odometry benchmark has them. All methods
go the same road: tracks, first pose and points, pose of each frame, adjustment of the last
keyframes. The truth is used for one number, the scale, and to measure the errors.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from deepdetect import (
    Camera,
    DeepDetect,
    DeepDetectError,
    Keypoints,
    MissingExtraError,
    load_image,
)
from deepdetect.evaluation.metrics.trajectory import TrajectoryErrors, trajectory_errors
from deepdetect.features.matchers import get_matcher, match_descriptors
from deepdetect.features.sift import described_at_own_size, to_root_sift
from deepdetect.io.image import find_images, luma
from deepdetect.tracking import (
    TrackedFrame,
    Tracker,
    TrackingOptions,
    Trajectory,
    VisualOdometry,
    load_poses,
    point_candidates,
    save_poses,
)

RATIO = 0.85
"""Of Lowe's test, where described keypoints are matched."""

COLORS = {"DeepDetect": "C0", "SIFT": "C1", "ORB": "C2"}
NAMES = (*COLORS, *(f"{name}, matched" for name in COLORS))
"""Of the methods."""

Update = Callable[[np.ndarray], TrackedFrame]


def by_flow(detect: Callable[[np.ndarray], Keypoints], options: TrackingOptions) -> Update:
    """Follow keypoints by Lucas-Kanade, as `deepdetect track` does."""
    return Tracker(detect, options).update


def by_matching(detect: Callable[[np.ndarray], Keypoints], matcher: str, ratio: float) -> Update:
    """Follow described keypoints by matching those of each frame with the frame before."""
    before: dict[str, np.ndarray] = {}
    number = -1

    def update(rgb: np.ndarray) -> TrackedFrame:
        nonlocal number
        number += 1
        found = detect(rgb)
        tracks = np.full(len(found), -1, np.int64)
        if before:
            pairs = match_descriptors(
                before["descriptors"],
                found.descriptors,
                get_matcher(matcher),
                ratio=ratio,
                mutual=True,
            )
            tracks[pairs.rows1] = before["tracks"][pairs.rows0]
        born = tracks < 0
        first = before["next"] if before else 0
        tracks[born] = first + np.arange(np.count_nonzero(born))
        before.update(
            descriptors=found.descriptors, tracks=tracks, next=tracks.max(initial=first - 1) + 1
        )
        order = np.argsort(tracks)
        return TrackedFrame(
            number, tracks[order], found.xy[order], found.scores[order], (~born[order]).astype(int)
        )

    return update


def methods(count: int) -> dict[str, Callable[[], Update]]:
    """Return what follows keypoints, by name; each is made anew for each video."""
    import cv2  # after DeepDetect, whichever package of OpenCV is installed

    detector = DeepDetect()
    options = TrackingOptions(max_keypoints=count)
    most = options.candidates * count
    sift, orb = cv2.SIFT_create(most), cv2.ORB_create(most)

    def opencv(feature: cv2.Feature2D, describe: bool) -> Callable[[np.ndarray], Keypoints]:
        def detect(rgb: np.ndarray) -> Keypoints:
            gray, size = luma(rgb), (rgb.shape[1], rgb.shape[0])
            if not describe:
                return Keypoints.from_opencv(feature.detect(gray, None), size)
            points, descriptors = feature.detectAndCompute(gray, None)
            if descriptors is None:  # there are no points
                descriptors = np.zeros((0, feature.descriptorSize()), np.uint8)
            if feature.defaultNorm() == cv2.NORM_L2:
                descriptors = to_root_sift(descriptors.astype(np.uint8))
            found = Keypoints.from_opencv(points, size)
            return Keypoints(found.xy, found.scores, size, descriptors=descriptors)

        return detect

    candidates = point_candidates(detector, options)

    def ours(rgb: np.ndarray) -> Keypoints:
        return described_at_own_size(luma(rgb), candidates(rgb))

    return {
        "DeepDetect": lambda: by_flow(candidates, options),
        "SIFT": lambda: by_flow(opencv(sift, False), options),
        "ORB": lambda: by_flow(opencv(orb, False), options),
        "DeepDetect, matched": lambda: by_matching(ours, "exact", RATIO),
        "SIFT, matched": lambda: by_matching(opencv(sift, True), "exact", RATIO),
        "ORB, matched": lambda: by_matching(opencv(orb, True), "hamming", RATIO),
    }


def run(update: Update, paths: list[Path], camera: Camera) -> tuple[VisualOdometry, float, float]:
    """Return the odometry of a video, and seconds per frame of wall and of CPU time."""
    odometry = VisualOdometry(camera)
    wall, cpu = time.perf_counter(), time.process_time()
    for path in paths:
        odometry.update(update(load_image(path)))
    count = len(paths)
    return odometry, (time.perf_counter() - wall) / count, (time.process_time() - cpu) / count


def read_camera(folder: Path) -> Camera:
    """Read the first camera of KITTI's calib.txt.

    Raises:
        DeepDetectError: the file is missing or is another, or a frame cannot be read.
    """
    file = folder / "calib.txt"
    try:
        line = file.read_text(encoding="ascii").partition("\n")[0]
        matrix = np.array(line.split(":")[-1].split(), float).reshape(3, 4)
    except FileNotFoundError:
        raise DeepDetectError(
            f"there is no file {file}: give a folder with frames, calib.txt and poses.txt as KITTI "
            "has them"
        ) from None
    except (OSError, ValueError):
        raise DeepDetectError(
            f"the first line of {file} must be twelve numbers, the projection matrix of the camera"
        ) from None
    height, width = load_image(find_images(folder)[0]).shape[:2]
    return Camera((width, height), (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))


def read_sequence(
    folder: Path, first: int, count: int | None
) -> tuple[list[Path], Camera, Trajectory]:
    """Return frames, their camera, and the true path, which begins with frame 0.

    Raises:
        DeepDetectError: a file is missing, or there are fewer than two frames.
    """
    last = None if count is None else first + count
    paths = find_images(folder)[first:last]
    camera, truth = read_camera(folder), load_poses(folder / "poses.txt")
    if first < 0 or len(paths) < 2:
        raise DeepDetectError(f"there are not two frames from number {first} on: give others")
    if len(truth) < first + len(paths):
        raise DeepDetectError(
            f"{folder / 'poses.txt'} has {len(truth)} lines, too few for frame "
            f"{first + len(paths) - 1}: give a line for each frame, or fewer --frames"
        )
    truth = truth.at(np.arange(first, first + len(paths)))
    return paths, camera, Trajectory(np.arange(len(paths)), truth.rotations, truth.centres)


def measure(found: Trajectory, truth: Trajectory) -> TrajectoryErrors:
    """Return the errors of a trajectory."""
    true = truth.at(found.frames)
    return trajectory_errors(found.rotations, found.centres, true.rotations, true.centres)


def plot(paths: dict[str, np.ndarray], truth: np.ndarray, file: Path) -> None:
    """Draw trajectories from above and from the side against the truth."""
    from matplotlib.figure import Figure

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


def main() -> None:
    """Read the words of the command line; what is wrong ends it with a sentence."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("odometry"))
    parser.add_argument("--max-keypoints", type=int, default=TrackingOptions.max_keypoints)
    parser.add_argument("--first", type=int, default=0, help="first frame")
    parser.add_argument("--frames", type=int, help="how many  [default: all]")
    parser.add_argument("--methods", nargs="+", choices=NAMES, help="some of them")
    arguments = parser.parse_args()
    try:
        compare(arguments)
    except DeepDetectError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")
    except OSError as error:
        parser.exit(2, f"{parser.prog}: cannot write {arguments.output} ({error.strerror})\n")


def compare(arguments: argparse.Namespace) -> None:
    """Run all methods, print a table, and write poses and the plot."""
    if importlib.util.find_spec("matplotlib") is None:
        raise MissingExtraError("the plot needs matplotlib: pip install matplotlib")
    paths, camera, truth = read_sequence(arguments.folder, arguments.first, arguments.frames)
    arguments.output.mkdir(parents=True, exist_ok=True)
    numbers, shown = {}, {}
    print(f"{len(paths)} frames, {truth.length:.1f} m")
    print(
        "method               frames  end %  mean %  end °/m  segments %  °/m     CPU s/frame  wall"
    )
    for name, make in methods(arguments.max_keypoints).items():
        if arguments.methods and name not in arguments.methods:
            continue
        odometry, wall, cpu = run(make(), paths, camera)
        found = odometry.trajectory()
        if len(found) < 2:
            print(f"{name:20} no path was found")
            continue
        errors = measure(found, truth)
        print(
            f"{name:20} {len(found):6} {errors.end_percent:6.2f} {errors.mean_percent:7.2f} "
            f"{errors.end_deg_per_m:8.4f} {errors.segment_percent:11.2f} "
            f"{errors.segment_deg_per_m:7.4f} {cpu:11.3f} {wall:6.3f}",
            flush=True,
        )
        save_poses(found, arguments.output / f"{name.replace(', ', '-').lower()}.txt")
        numbers[name] = {
            **{key: value for key, value in vars(errors).items() if key != "centres"},
            "frames": len(found),
            "cpu_s_per_frame": cpu,
            "wall_s_per_frame": wall,
        }
        if name in COLORS:
            shown[name] = errors.centres
    plot(shown, truth.centres, arguments.output / "trajectory.jpg")
    (arguments.output / "errors.json").write_text(json.dumps(numbers, indent=2), encoding="utf-8")


if __name__ == "__main__":
    main()
