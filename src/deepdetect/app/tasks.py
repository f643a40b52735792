"""Tasks that the page can run in Python: one function and one entry of `TASKS` each.

A task reads images, reports its progress, writes files, and returns what the page shows.
"""

from __future__ import annotations

import importlib.util
import itertools
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .._shared.errors import DeepDetectError, OptionError, ReconstructionError, install_command
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.pictures import draw_all_matches
from ..io.exif import calibration_from_exif
from ..io.image import load_pixels
from ..io.picture_file import save_picture
from ..io.tables import save_keypoints, save_matches
from ..matching.pipeline import GUIDED_STAGES, match_images
from ..matching.registration import register
from ..matching.stitching import stages_of, stitch
from ..reconstruction.pipeline import reconstruct
from ..reconstruction.result import ENDINGS, save_reconstruction
from ..sfm.colmap import ESTIMATED_FOCAL_FACTOR
from ..sfm.pipeline import reconstruct_many

FOLDER_KEYPOINTS = 2048
MODEL_STAGES = 9
"""Maximum number of progress stages of a 3D model, including the writing of its files."""

Report = Callable[[str, int, int], None]
"""Function called when a stage begins, with its name, the number of stages done, and the number
of all stages, which is 0 if unknown."""

Options = Mapping[str, float]


@dataclass(frozen=True)
class SentImage:
    """Image file that the page sent. The user's `name` for it is never used as a path."""

    path: Path
    name: str


Images = Sequence[SentImage]


@dataclass(frozen=True)
class Order:
    """A task to run. `folder` belongs to this task only, and contains the images."""

    kind: str
    images: Images
    options: Options
    folder: Path
    max_megapixels: float


@dataclass(frozen=True)
class TaskResult:
    """Result of a task: its numbers as text by label, a file to show, files to download."""

    numbers: Mapping[str, str]
    shown: str
    files: Sequence[str]


@dataclass(frozen=True)
class Task:
    """A kind of task that the page offers.

    `files` are the smallest and the largest number of images; None stands for the server's limit.
    `packages` are packages that the task needs and that are not installed with DeepDetect.
    `options` maps names of numeric options to their labels on the page. If `folder` is set, the
    page offers the task for whole folders, otherwise for chosen images.
    """

    title: str
    note: str
    run: Callable[[Images, Options, Path, Report], TaskResult]
    files: tuple[int, int | None]
    packages: tuple[str, ...] = ()
    options: Mapping[str, str] = field(default_factory=dict)
    folder: bool = False

    @property
    def missing(self) -> str:
        """The command that installs missing packages, or an empty string if none is missing."""
        absent = [name for name in self.packages if importlib.util.find_spec(name) is None]
        return install_command(*absent) if absent else ""

    def check(self, count: int, options: Mapping[str, object]) -> dict[str, float]:
        """Check the options and the number of images; return the options as numbers."""
        least, most = self.files
        if count < least or (most is not None and count > most):
            number = f"{least}" if most == least else f"at least {least}"
            plural = "" if least == 1 else "s"
            raise OptionError(f"{self.title} takes {number} image{plural}, not {count}")
        if self.missing:
            raise OptionError(f"{self.title} needs another package: {self.missing}")
        for name, value in options.items():
            real = isinstance(value, (int, float)) and not isinstance(value, bool)
            if name not in self.options or not real or not 0 < value < 1e6:  # type: ignore[operator]
                raise OptionError(
                    f"{self.title} does not accept {name!r:.40} with the value {value!r:.40}"
                )
        return {name: float(value) for name, value in options.items()}  # type: ignore[arg-type]


def run_match(images: Images, options: Options, folder: Path, report: Report) -> TaskResult:
    """Match two images, guided by a geometry that is estimated first."""
    stages = _stages(GUIDED_STAGES, report)
    first, second = (load_pixels(one.path) for one in images)
    matches = match_images(first, second, progress=stages)
    if not matches.success:
        raise DeepDetectError("no geometry can be trusted: both images must show the same scene")
    save_matches(matches, folder / "matches.csv")
    save_matches(matches, folder / "matches.npz")
    save_picture(draw_all_matches(first, second, matches), folder / "matches.jpg")
    model = "none" if matches.geometry is None else matches.geometry.model
    numbers = {
        "Keypoints": f"{len(matches.keypoints0):,} and {len(matches.keypoints1):,}",
        "Matches": f"{len(matches):,}",
        f"Agree ({model})": f"{int(matches.inliers.sum()):,}",
    }
    return TaskResult(numbers, "matches.jpg", ("matches.csv", "matches.npz", "matches.jpg"))


def run_register(images: Images, options: Options, folder: Path, report: Report) -> TaskResult:
    """Warp the second image into the frame of the first."""
    stages = _stages(GUIDED_STAGES, report)
    found = register(images[0].path, images[1].path, progress=stages)
    pictures = {
        "checkerboard.png": found.checkerboard(),
        "registered.png": found.warped,
        "difference.png": found.difference(),
    }
    for name, picture in pictures.items():
        save_picture(picture, folder / name)
    np.savetxt(folder / "homography.txt", found.homography, fmt="%.12e")
    numbers = {
        "Matches": f"{found.matches:,}",
        "Overlap": f"{found.valid.mean():.0%} of the first",
        "Correlation": f"{found.zncc:.3f} (1 means identical)",
    }
    return TaskResult(numbers, "checkerboard.png", (*pictures, "homography.txt"))


def run_stitch(images: Images, options: Options, folder: Path, report: Report) -> TaskResult:
    """Stitch the images to one panorama; the result lists the images that are left out."""
    stages = _stages(stages_of(len(images)), report)
    panorama = stitch([one.path for one in images], progress=stages)
    save_picture(panorama.image, folder / "panorama.jpg", value_range=panorama.value_range)
    height, width = panorama.image.shape[:2]
    used = len(images) - len(panorama.unregistered)
    numbers = {
        "Images": f"{used} of {len(images)}",
        "Size": f"{width}×{height}, {panorama.valid.mean():.0%} covered",
    }
    others = [images[number].name for number in panorama.unregistered]
    if others:
        numbers["Left out"] = ", ".join(others)
    return TaskResult(numbers, "panorama.jpg", ("panorama.jpg",))


def run_reconstruct(images: Images, options: Options, folder: Path, report: Report) -> TaskResult:
    """Reconstruct a 3D model from two images."""
    done = itertools.count(1)
    report("starting", 0, MODEL_STAGES)
    left, right = (one.path for one in images)
    sizes = [load_pixels(path).shape[1::-1] for path in (left, right)]
    focal_px, assumed = options.get("focal_px"), False
    if focal_px is None:
        try:
            calibration_from_exif(left, right, *sizes)
        except ReconstructionError:
            focal_px, assumed = ESTIMATED_FOCAL_FACTOR * max(sizes[0]), True
    found = reconstruct(
        left,
        right,
        DeepDetect("dense"),
        focal_px=focal_px,
        progress=lambda name: report(f"after {name}", next(done), MODEL_STAGES),
    )
    report("files", MODEL_STAGES - 1, MODEL_STAGES)
    files = {ending: folder / f"model{ending}" for ending in ENDINGS}
    values = save_reconstruction(found, files, " and ".join(one.name for one in images))
    focal = (
        f"{focal_px:.0f} px, assumed: {ESTIMATED_FOCAL_FACTOR} times the longer side"
        if assumed
        else found.calibration.source
    )
    numbers = {
        "Points": f"{len(found):,}",
        "Matches": f"{found.matches:,}",
        "Pair": "rectified" if found.rectified else "not rectified",
        "Focal length": focal,
        "Scale": values["scale"],
    }
    return TaskResult(numbers, "model.html", [path.name for path in files.values()])


def run_reconstruct_many(
    images: Images, options: Options, folder: Path, report: Report
) -> TaskResult:
    """Reconstruct cameras and a dense model from many images."""
    report("cameras and points of all images", 0, 0)
    work = folder / "work"
    found = reconstruct_many([one.path for one in images], work)
    names = ["model.html", "model.ply", "model.glb", "model.json"]
    for name in names:
        (work / name).rename(folder / name)
    numbers = {
        "Images": f"{len(found.views)} of {len(images)}",
        "Unregistered": f"{len(found.unregistered)}",
    }
    return TaskResult(numbers, "model.html", names)


def run_folder_keypoints(
    images: Images, options: Options, folder: Path, report: Report
) -> TaskResult:
    """Write the best keypoints of each image as a CSV file into one ZIP file."""
    detector = PointDetector(FOLDER_KEYPOINTS)
    table, failures = folder / "table.csv", []
    shown, total = "", 0
    with zipfile.ZipFile(folder / "keypoints.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for number, one in enumerate(images):
            report(one.name, number, len(images))
            try:
                rgb = load_pixels(one.path)
            except DeepDetectError as error:
                failures.append(str(error).replace(str(one.path), one.name))
                continue
            keypoints = detector.detect(rgb)
            save_keypoints(keypoints, table)
            archive.write(table, _entry_name(one.name, archive.namelist()))
            total += len(keypoints)
            if not shown:
                shown = "keypoints.jpg"
                save_picture(keypoints.draw(rgb), folder / shown)
        if failures:
            archive.writestr("failures.txt", "\n".join(failures) + "\n")
    table.unlink(missing_ok=True)
    if not shown:
        raise DeepDetectError(f"no image can be read: {failures[0]}")
    numbers = {
        "Images": f"{len(images) - len(failures)} of {len(images)}",
        "Keypoints": f"{total:,}",
    }
    return TaskResult(numbers, shown, ("keypoints.zip",))


def _entry_name(name: str, others: Sequence[str]) -> str:
    """Return a name for an image's CSV file in a ZIP file: without folders, and not in `others`.

    Example:
        >>> _entry_name("a/b.jpg", []), _entry_name("../b", ["b.csv"])
        ('b.csv', 'b_2.csv')
    """
    stem = re.sub(r"[^\w -]", "_", Path(name.replace("\\", "/")).stem) or "image"
    names = itertools.chain([f"{stem}.csv"], (f"{stem}_{k}.csv" for k in itertools.count(2)))
    return next(name for name in names if name not in others)


def _stages(names: Sequence[str], report: Report) -> Callable[[str], None]:
    """Report the first stage; return a function to call whenever a stage ends.

    A last stage, "files", is added for the writing of the results.
    """
    all_names, done = [*names, "files"], itertools.count()

    def ended(_: str) -> None:
        number = next(done)
        report(all_names[number], number, len(all_names))

    ended("")
    return ended


TASKS: dict[str, Task] = {
    "match": Task("Guided matching", "all matches that agree with one geometry", run_match, (2, 2)),
    "register": Task(
        "Registration", "the second image in the frame of the first", run_register, (2, 2)
    ),
    "stitch": Task("Panorama", "from overlapping images", run_stitch, (2, None)),
    "reconstruct": Task(
        "3D model",
        "coloured points, and a depth map",
        run_reconstruct,
        (2, 2),
        options={"focal_px": "Focal length in pixels, if the images' EXIF lacks it"},
    ),
    "folder-keypoints": Task(
        "Keypoints",
        "the best keypoints of each image, as CSV files",
        run_folder_keypoints,
        (1, None),
        folder=True,
    ),
    "folder-stitch": Task("Panorama", "from all images", run_stitch, (2, None), folder=True),
    "folder-model": Task(
        "3D model",
        "from three or more images",
        run_reconstruct_many,
        (3, None),
        ("pycolmap", "h5py"),
        folder=True,
    ),
}
