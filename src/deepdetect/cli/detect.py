"""`deepdetect detect`: keypoints of images."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from .._shared.errors import OptionError, noted_failures
from .._shared.opencv import import_opencv
from .._shared.progress import progress
from .._shared.records import Outputs, plain
from ..detector.detector import DeepDetect, find_keypoints
from ..detector.point_detector import PointDetector
from ..features.pictures import draw_best_keypoints, draw_dense_keypoints
from ..features.selection import SelectionOptions, select_keypoints, without_frame
from ..io.image import load_visible, one_range
from ..io.image_file import reading_options
from ..io.masks import load_mask
from ..io.picture_file import save_picture
from ..io.tables import save_keypoints
from ..viz.draw import draw_logits
from . import _options as cli
from ._detection import NETWORK, POINTS, SELECTION, Detector, chosen_detector


@cli.command(SELECTION, POINTS, NETWORK, cli.READING)
def detect(
    *images: cli.Images,
    output: cli.Folder = Path("deepdetect-output"),
    detector: Detector = "network",
    ignore: Path | None = None,
    file_format: cli.Format = "npz",
    pictures: bool = True,
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Detect keypoints in images (files or folders).

    Writes for each image STEM.npz (or .csv) with the positions and scores, and visualisations:
    STEM_keypoints.jpg (the best keypoints of each part of the image, coloured by score) and, for
    the network, STEM_dense.jpg (all keypoints) and STEM_heatmap.jpg (logits). Results of images in
    subfolders go to subfolders of the same names.

    Run again, the command skips finished images, unless its options have changed. Results of other
    images with the same name, and files of unknown origin, are replaced only with --overwrite. If
    no image has any keypoint, the exit code is 3.

        deepdetect detect photo.jpg
        deepdetect detect photos/ -o keypoints --detector points --spread grid
        deepdetect detect photo.jpg --density 0.1 --no-pictures -o points.csv

    Args:
        ignore: Mask image of the same size as the images: bright pixels get no keypoints.
        pictures: Also write visualisations.
    """
    import_opencv()  # if OpenCV is missing, fails before anything is written
    stems = cli.result_stems(cli.expand_images(images, output))
    paths = [*stems]
    drawn = ("keypoints", "dense", "heatmap") if detector == "network" else ("keypoints",)
    endings = {"file": f".{file_format}"} | {n: f"_{n}.jpg" for n in drawn if pictures}
    outputs = {path: cli.output_files(output, stem, endings) for path, stem in stems.items()}
    cli.check_outputs([file for files in outputs.values() for file in files.values()], paths)
    mask = None if ignore is None else load_mask(ignore)
    if detector == "network" and "max_keypoints" in values:
        cli.say(
            "--max-keypoints keeps the best pixels of the heat map; --detector points finds better "
            "keypoints"
        )
    work = _Work(*chosen_detector(detector, values), mask, overwrite)
    work.say_what_is_replaced(outputs)
    results: list[dict[str, Any]] = []
    failures: list[str] = []
    quiet = len(paths) == 1
    with one_range(paths), progress(len(paths), "detecting", "image", quiet=quiet) as bar:
        for path, files in outputs.items():
            with noted_failures(str(path), failures):
                results.append(work.detect(path, files))
            bar.update(1)
    nothing = not failures and not any(result["keypoints"] for result in results)
    if nothing:
        cli.say("no keypoint was found: the image is uniform, or the options allow none")
    backend = getattr(work.detector, "runtime", None)
    return cli.Result(
        {"backend": backend, "images": results, "failures": failures},
        "\n".join(map(_line, results)),
        failures,
        len(paths),
        exit_code=cli.NOTHING_FOUND if nothing else 0,
    )


def _line(result: dict[str, Any]) -> str:
    how = "already done" if result["skipped"] else f"{result['seconds']:.2f} s"
    found = f"{result['keypoints']:,} keypoints, {result['density']:.1%} of the pixels"
    also = " and pictures" if result["pictures"] else ""
    return f"{result['image']}: {found}, {how} -> {result['file']}{also}"


@dataclass(frozen=True)
class _Work:
    """Detection of keypoints in those images that have no results yet."""

    detector: DeepDetect | PointDetector
    selection: SelectionOptions | None
    mask: np.ndarray | None
    overwrite: bool

    @cached_property
    def settings(self) -> dict[str, Any]:
        options = vars(self.selection or SelectionOptions())
        noted = {"ignore": self.mask, "version": __version__}
        return dict(plain(self.detector.settings | options | noted | reading_options().settings))

    def say_what_is_replaced(self, outputs: dict[Path, dict[str, Path]]) -> None:
        """Print which options have changed since the results of these images were written.

        Raise an OptionError if results of other images would be replaced.
        """
        changed, names = [], set()
        for path, files in outputs.items():
            Outputs([*files.values()], [path], overwrite=self.overwrite).find()
            before = Outputs([files["file"]], [path], overwrite=self.overwrite).find()
            if before is not None and (old := before["settings"]) != self.settings:
                both = {**old, **self.settings}
                names |= {name for name in both if old.get(name) != self.settings.get(name)}
                changed.append(path)
        if changed:
            names = {"detector"} if "detector" in names else names
            flags = ", ".join("--" + name.replace("_", "-") for name in sorted(names))
            whose = str(changed[0]) if len(changed) == 1 else f"{len(changed)} images"
            cli.say(f"replacing the results of {whose}, made with other options ({flags})")

    def detect(self, path: Path, files: dict[str, Path]) -> dict[str, Any]:
        shown = {"file": files["file"], "pictures": {n: files[n] for n in files if n != "file"}}
        outputs = Outputs([*files.values()], [path], overwrite=self.overwrite)
        done = outputs.find()  # another process may have finished the image meanwhile
        if done is not None and done["settings"] == self.settings:
            return {"image": path, **done["numbers"], **shown, "skipped": True}
        earlier = None if self.overwrite else Outputs([files["file"]], [path]).find()
        started = time.perf_counter()
        rgb, mask = load_visible(path, ignore=self.mask)
        if "dense" in files and isinstance(self.detector, DeepDetect):
            # Both maps come from one call, so that the network runs only once.
            heatmap, logits = self.detector.heatmap_and_logits(rgb)
            selection = self.selection or SelectionOptions()
            mask = without_frame(rgb, mask)
            keypoints = select_keypoints(heatmap, selection, logits, ignore=mask)
        else:
            keypoints = find_keypoints(self.detector, rgb, self.selection, mask)
        seconds = time.perf_counter() - started
        numbers = {
            "width": keypoints.image_size[0],
            "height": keypoints.image_size[1],
            "keypoints": len(keypoints),
            "density": round(keypoints.density, 6),
            "seconds": round(seconds, 4),
        }
        with outputs.writing() as noted, cli.whole(files) as made:
            save_keypoints(keypoints, made["file"])
            if "keypoints" in made:
                save_picture(draw_best_keypoints(rgb, keypoints), made["keypoints"])
            if "dense" in made:
                save_picture(draw_dense_keypoints(rgb, keypoints), made["dense"])
                save_picture(draw_logits(logits), made["heatmap"])
            written = [file.name for file in outputs.paths]
            noted |= {"numbers": numbers, "settings": self.settings, "files": written}
        for name in (earlier or {}).get("files", ()):
            old = files["file"].with_name(name)
            with contextlib.suppress(OptionError):  # keeps a file that a user has changed
                if old not in outputs.paths and Outputs([old], [path]).find():
                    old.unlink()
        return {"image": path, **numbers, **shown, "skipped": False}
