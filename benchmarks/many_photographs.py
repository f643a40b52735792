"""Compare reconstructions of many photographs with pycolmap's own SIFT, by the true cameras.

    python benchmarks/many_photographs.py SCENE [--output FOLDER] [--pictures FOLDER] [--bad FOLDER]
        [--resume] [--workers N] [--limits] [--road METRES] [--model FOLDER]

SCENE is a folder of photographs with known cameras (docs/benchmarks.md lists the layouts). Both
pipelines run with the true intrinsics and with estimated ones. Printed are the photographs that are
registered, mean errors of camera centres and rotations after the alignment of the centres, points,
reprojection errors and CPU seconds. `--pictures` draws the cameras, the sparse and the dense model.
With `--bad` the photographs of that folder are added, and a black and a damaged one. `--limits`,
after a run without it, shows what the errors of the poses consist of: the last adjustment is made
again from two random halves of the sparse points, and with other losses. With `--road` SCENE is a
drive, and METRES the height of its camera: where the car drove there is nothing but road, and so
dense points there that are no road are wrong. `--model` makes nothing: it prints how near the
cameras of a model that `deepdetect reconstruct` has written come to the true ones.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from deepdetect import Camera, MultiViewReconstruction, PointCloud, reconstruct_many
from deepdetect.datasets.posed_images import PosedScene, load_posed_scenes
from deepdetect.evaluation.metrics.multi_view import camera_errors, relative_pose_errors
from deepdetect.evaluation.metrics.pose import pose_auc
from deepdetect.geometry.point_cloud import robust_box
from deepdetect.geometry.posed_view import PosedView
from deepdetect.io.html_viewer import camera_lines
from deepdetect.io.image import find_images, load_image
from deepdetect.sfm.colmap import quiet_pycolmap
from deepdetect.sfm.mapping import MappingOptions, adjust, read_sparse_model
from deepdetect.viz.render import ViewCamera, orbit_camera, render

LINE_POINTS = 300
"""That draw a line of a camera."""

PICTURE_SIZE = (900, 560)

DRIVE_PAIRS = 8
"""Following frames that each frame of a drive is matched with."""

LANE_M = 0.75
"""To both sides of the camera: the car was there."""

MAX_ABEAM_M = 1.0
"""Ahead of or behind a camera, of points beside it: the distance of two frames."""

ROAD_M = (0.1, 0.2, 0.3)
"""Distances from the road of which the share of points is printed."""

AUC_DEG = (1, 5)
"""Of relative poses, to which the area under the curve of their errors is printed."""

NEAR = 1.5
"""Points are drawn up to this many times their median depth."""


def main() -> None:
    """Print a row for each pipeline."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("--output", type=Path, default=Path("deepdetect-output/many"))
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the model")
    parser.add_argument("--bad", type=Path, help="folder of photographs of something else")
    parser.add_argument("--workers", type=int, help="processes")
    parser.add_argument("--limits", action="store_true", help="what the errors consist of")
    parser.add_argument("--road", type=float, help="metres of the camera above the road")
    parser.add_argument("--model", type=Path, help="folder of a model to compare with the truth")
    parser.add_argument("--resume", action="store_true", help="keep what earlier runs have made")
    args = parser.parse_args()
    (scene,) = load_posed_scenes(args.scene)
    names = sorted(image.path.name for image in scene.images)
    if args.bad is not None:
        show_bad(scene, args.bad, args.output / "bad", args.workers)
        return
    if args.model is not None:
        show_model(scene, args.model / "sparse")
        return
    if args.road is not None:
        output = args.output / "drive"
        show_road(scene, args.road, output, args.workers, args.resume, args.pictures)
        return
    if args.limits:
        show_limits(scene, args.output / "true-plain" / "sparse")
        return
    camera = true_camera(scene)
    print(
        "| pipeline | registered | centres, mm | rotations, ° | sparse points | their error, px "
        "| dense points | their error, px | CPU s |\n|---|---:|---:|---:|---:|---:|---:|---:|---:|"
    )
    for known in (True, False):
        cameras = "true" if known else "estimated"
        started = cpu_seconds()
        model = map_by_sift(args.scene, names, camera if known else None, args.output / "sift")
        for title in ("SIFT", "SIFT and our last adjustment"):
            sparse = read_sparse_model(model)
            views = {view.name: view for view in sparse.views.values()}
            error = sparse.errors.mean()
            count = len(sparse.points)
            row(f"{title}, {cameras} intrinsics", scene, views, count, error, None, started)
            adjust(model, known, MappingOptions().robust_scale_px)
        for refined in (False, True):
            started = cpu_seconds()
            found = reconstruct_many(
                [args.scene / name for name in names],
                args.output / f"{cameras}-{'refined' if refined else 'plain'}",
                calibration=camera if known else None,
                dense=known and not refined,
                refine_tracks=refined,
                workers=args.workers,
                overwrite=not args.resume,
            )
            title = f"ours, {cameras} intrinsics" + (", tracks refined" if refined else "")
            errors = found.sparse_errors.mean()
            row(title, scene, found.views, len(found.sparse), errors, found, started)
            if args.pictures is not None and len(found.dense):
                draw(found, args.scene, args.pictures)


def cpu_seconds() -> float:
    """Return what this process and those that it has started have used."""
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(each.ru_utime + each.ru_stime for each in used)


def true_camera(scene: PosedScene) -> Camera:
    """Return the camera of all photographs."""
    matrix = scene.images[0].intrinsics
    height, width = load_image(scene.images[0].path).shape[:2]
    return Camera((width, height), (matrix[0, 0], matrix[1, 1]), (matrix[0, 2], matrix[1, 2]))


def map_by_sift(folder: Path, names: list[str], camera: Camera | None, output: Path) -> Any:
    """Run pycolmap's own pipeline with its defaults; return the largest model."""
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    with quiet_pycolmap() as pycolmap:
        reading, mapping = pycolmap.ImageReaderOptions(), pycolmap.IncrementalPipelineOptions()
        if camera is not None:
            reading.camera_model = "PINHOLE"
            centre = (camera.centre[0] + 0.5, camera.centre[1] + 0.5)
            reading.camera_params = ",".join(map(str, (*camera.focal_px, *centre)))
            mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
        pycolmap.extract_features(
            output / "database.db",
            folder,
            image_names=names,
            camera_mode=pycolmap.CameraMode.SINGLE,
            reader_options=reading,
        )
        pycolmap.match_exhaustive(output / "database.db")
        models = pycolmap.incremental_mapping(output / "database.db", folder, output, mapping)
    return max(models.values(), key=lambda model: model.num_reg_images())


def row(
    title: str,
    scene: PosedScene,
    views: dict,
    points: int,
    error: float,
    found: MultiViewReconstruction | None,
    started: float,
) -> None:
    """Print a row of the table."""
    centres, rotations = pose_errors(scene, views)
    dense = found is not None and len(found.dense)
    last = f"{len(found.dense):,} | {np.median(found.dense_errors):.3f}" if dense else "– | –"
    print(
        f"| {title} | {len(views)} of {len(scene.images)} | {1000 * centres:.2f} | {rotations:.3f} "
        f"| {points:,} | {error:.2f} | {last} | {cpu_seconds() - started:.0f} |",
        flush=True,
    )


def true_views(scene: PosedScene) -> dict[str, PosedView]:
    """Return the true cameras by the names of the photographs."""
    camera = true_camera(scene)
    return {
        image.path.name: PosedView(image.path.name, camera, image.rotation, image.translation)
        for image in scene.images
    }


def pose_errors(scene: PosedScene, views: dict) -> tuple[float, float]:
    """Return mean errors of centres, in the scene's unit, and of rotations in degrees."""
    truth = true_views(scene)
    found = camera_errors(list(views.values()), [truth[name] for name in views])
    return float(found.centres.mean()), float(found.rotations_deg.mean())


def show_model(scene: PosedScene, folder: Path) -> None:
    """Print how near the cameras of a sparse model come to the true ones."""
    with quiet_pycolmap() as pycolmap:
        sparse = read_sparse_model(pycolmap.Reconstruction(folder))
    views = {view.name: view for view in sparse.views.values()}
    truth = true_views(scene)
    if missing := set(views) - set(truth):
        raise SystemExit(f"{min(missing)} of the model is no photograph of {scene.name}")
    print(
        f"{len(views)} of {len(truth)} photographs, {len(sparse.points):,} sparse points, each in "
        f"{sparse.tracks.mean():.1f} of them\n{compare_cameras(views, truth)}"
    )


def compare_cameras(views: dict[str, PosedView], truth: dict[str, PosedView]) -> str:
    """Return the errors of centres and of relative poses as text."""
    centres = 1000 * camera_errors(list(views.values()), [truth[name] for name in views]).centres
    errors = relative_pose_errors(views, truth)
    curve = ", ".join(f"{pose_auc(errors, limit):.3f} at {limit}°" for limit in AUC_DEG)
    return (
        f"centres {centres.mean():.2f} mm (mean), {centres.max():.2f} mm (largest)\n"
        f"relative poses {np.median(errors):.2f}° (median), AUC {curve}"
    )


def show_limits(scene: PosedScene, folder: Path) -> None:
    """Adjust a model with the true intrinsics again, of half of its points and by other losses."""

    def adjusted(dropped: slice, seed: int, scale_px: float) -> dict[str, PosedView]:
        with quiet_pycolmap() as pycolmap:
            model = pycolmap.Reconstruction(folder)
        numbers = np.random.default_rng(seed).permutation(sorted(model.points3D))
        for number in numbers[dropped]:
            model.delete_point3D(int(number))
        adjust(model, True, scale_px)
        return {view.name: view for view in read_sparse_model(model).views.values()}

    def show(title: str, views: dict) -> None:
        centres, rotations = pose_errors(scene, views)
        print(f"{title}: centres {1000 * centres:.2f} mm, rotations {rotations:.3f} degrees")

    for scale_px in (0.1, 0.25, 0.5, 1.0, 2.0, 100.0):
        show(f"all points, loss at {scale_px:g} px", adjusted(slice(0), 0, scale_px))
    truth = true_views(scene)
    for seed in range(3):
        halves = [adjusted(slice(start, None, 2), seed, 1.0) for start in (0, 1)]
        for title, views in zip("AB", halves, strict=True):
            show(f"half {title} of the points, seed {seed}", views)
        first, second = halves
        unit = camera_errors(list(second.values()), [truth[name] for name in second]).scale
        apart = camera_errors([first[name] for name in second], list(second.values()))
        print(
            f"from half to half: centres {1000 * unit * apart.centres.mean():.2f} mm, "
            f"rotations {apart.rotations_deg.mean():.3f} degrees"
        )


def show_road(
    scene: PosedScene,
    height_m: float,
    output: Path,
    workers: int | None,
    resume: bool,
    pictures: Path | None,
) -> None:
    """Reconstruct a drive, and print where its dense points lie by the true path."""
    found = reconstruct_many(
        scene.images[0].path.parent,
        output,
        calibration=true_camera(scene),
        sequential=DRIVE_PAIRS,
        workers=workers,
        overwrite=not resume,
        quiet=False,
    )
    truth = true_views(scene)
    errors = camera_errors(list(found.views.values()), [truth[name] for name in found.views])
    scale, centres = errors.scale, 1000 * errors.centres
    print(f"{found}\ncentres {centres.mean():.0f} mm (mean), {centres.max():.0f} mm (largest)")
    points = found.dense.points.astype(np.float64)
    if not len(points):
        print("no dense points")
        return
    nearest = np.full(len(points), np.inf)
    beside = np.zeros((len(points), 3))  # metres from the camera that a point is beside
    for view in found.views.values():
        own = scale * ((points - view.centre) @ view.rotation.T)
        nearer = np.abs(own[:, 2]) < nearest
        nearest[nearer], beside[nearer] = np.abs(own[nearer, 2]), own[nearer]
    print(f"reprojection error {np.median(found.dense_errors):.3f} px (median)")
    print(compare_with_road(height_m - beside[:, 1], beside[:, 0], nearest < MAX_ABEAM_M))
    for metres in (20, 40, 80, 160):
        far = np.linalg.norm(scale * points - scale * found.centres.mean(axis=0), axis=1) > metres
        print(f"{far.mean():.1%} over {metres} m from the middle of the path")
    if pictures is not None:
        draw(found, scene.images[0].path.parent, pictures)


def compare_with_road(above_m: np.ndarray, aside_m: np.ndarray, abeam: np.ndarray) -> str:
    """Return as text where points lie that are beside the path.

    Args:
        above_m: (N,) heights above the road.
        aside_m: (N,) distances from the middle of the car.
        abeam: (N,) bool, beside the path.
    """
    if not abeam.any():
        return "no dense point lies beside the path"
    lane = abeam & (np.abs(aside_m) < LANE_M)
    lines = [
        f"{abeam.mean():.1%} of the dense points beside the path, {lane.sum():,} where it went"
    ]
    if lane.any():
        lines += [
            f"of these {(np.abs(above_m[lane]) < limit).mean():.1%} within {limit:g} m of the road"
            for limit in ROAD_M
        ]
        high, low = (above_m[lane] > ROAD_M[-1]).mean(), (above_m[lane] < -ROAD_M[-1]).mean()
        lines.append(f"{high:.1%} in the air, {low:.1%} under the road")
    high, low = (above_m[abeam] > 10).mean(), (above_m[abeam] < -0.5).mean()
    lines.append(
        f"of all beside the path {high:.1%} over 10 m above the road, {low:.1%} over .5 m under it"
    )
    return "\n".join(lines)


def show_bad(scene: PosedScene, bad: Path, output: Path, workers: int | None) -> None:
    """Reconstruct the scene with photographs that do not belong to it."""
    folder = output / "photos"
    folder.mkdir(parents=True, exist_ok=True)
    for image in scene.images:
        shutil.copy(image.path, folder)
    for path in find_images(bad):
        shutil.copy(path, folder / f"bad-{path.name}")
    height, width = load_image(scene.images[0].path).shape[:2]
    cv2.imwrite(str(folder / "black.png"), np.zeros((height, width, 3), np.uint8))
    (folder / "damaged.jpg").write_bytes(scene.images[0].path.read_bytes()[:20_000])
    started = time.perf_counter()
    found = reconstruct_many(folder, output / "model", dense=False, workers=workers)
    centres, rotations = pose_errors(scene, found.views)
    print(f"{found}\ncentres {1000 * centres:.2f} mm, rotations {rotations:.3f} degrees")
    for name, reason in found.left_out.items():
        print(f"{name}: {reason}")
    print(f"{time.perf_counter() - started:.0f} s")


def draw(found: MultiViewReconstruction, folder: Path, pictures: Path) -> None:
    """Draw the cameras with the sparse and with the dense points, and these from two sides."""
    pictures.mkdir(parents=True, exist_ok=True)
    ends = camera_lines(list(found.views.values()))
    steps = np.linspace(0, 1, LINE_POINTS)[:, None]
    lines = np.concatenate([start + steps * (end - start) for start, end in ends])
    red = np.tile(np.array([[200, 40, 30]], np.uint8), (len(lines), 1))
    # Houses far behind would make all else small.
    sparse, dense = (
        cloud[cloud.points[:, 2] < NEAR * np.median(cloud.points[:, 2])]
        for cloud in (found.sparse, found.dense)
    )
    for name, cloud, width in (("sparse", sparse, 2.0), ("dense", dense, 1.5)):
        joined = PointCloud(
            np.concatenate([cloud.points, lines]), np.concatenate([cloud.colors, red]), cloud.unit
        )
        save(pictures / f"{name}.jpg", render(joined, overview(cloud, lines), width))
    for name, azimuth, elevation in (("front", 0, 0), ("side", 30, 12)):
        camera = orbit_camera(dense, azimuth, elevation, PICTURE_SIZE)
        save(pictures / f"dense-{name}.jpg", render(dense, camera))


def overview(cloud: PointCloud, lines: np.ndarray) -> ViewCamera:
    """Place a camera behind and above, so that it sees the cloud and the cameras."""
    camera = orbit_camera(cloud, 25, 40, PICTURE_SIZE)
    box = robust_box(cloud)
    inside = ((cloud.points > box.low) & (cloud.points < box.high)).all(axis=1)
    shown = np.concatenate([cloud.points[inside], lines])
    camera = replace(camera, position=box.centre + 2.5 * (camera.position - box.centre))
    plain = replace(camera, focal=1.0, principal_point=np.zeros(2))
    xy, _ = plain.project(shown)
    low, high = xy.min(axis=0), xy.max(axis=0)
    focal = float((0.95 * np.array(PICTURE_SIZE) / (high - low)).min())
    middle = (np.array(PICTURE_SIZE) - 1) / 2 - focal * (low + high) / 2
    return replace(camera, focal=focal, principal_point=middle)


def save(path: Path, picture: np.ndarray) -> None:
    """Write a picture as JPEG."""
    cv2.imwrite(str(path), picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    main()
