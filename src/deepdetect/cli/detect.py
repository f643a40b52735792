"""`deepdetect detect`: keypoints of images."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from .._shared.errors import DeepDetectError, MissingExtraError, OptionError, WeightsError
from .._shared.opencv import import_opencv
from .._shared.progress import progress
from .._shared.records import Outputs, plain
from ..detector.detector import DeepDetect, find_keypoints
from ..detector.point_detector import PointDetector
from ..features.selection import SelectionOptions, select_keypoints
from ..io.image import load_image
from ..io.masks import load_mask
from ..io.tables import save_keypoints
from ..viz.draw import draw_best_keypoints, draw_dense_keypoints, draw_logits, save_picture
from . import _options as cli
from ._detection import NETWORK, POINTS, SELECTION, Detector, chosen_detector


@cli.with_options(SELECTION, POINTS, NETWORK)
def detect(
    images: cli.Images,
    /,
    *,
    output: cli.Folder = Path("deepdetect-output"),
    detector: Detector = "network",
    ignore: Path | None = None,
    file_format: cli.Format = "npz",
    pictures: bool = True,
    overwrite: cli.Overwrite = False,
    as_json: cli.Json = False,
    max_megapixels: cli.MaxMegapixels = 200,
    **values: Any,
) -> int:
    """Detect the keypoints of images (files or folders).

    Writes for each image STEM.npz (or .csv) with the positions and scores, and the pictures
    STEM_keypoints.jpg (the best of all parts of the image, coloured by score), and of the network
    STEM_dense.jpg (all keypoints) and STEM_heatmap.jpg (logits).

    Images that are done are skipped when the same command runs again, and done again with other
    options. What was made from other images of the same name, or by something else, is replaced
    with --overwrite only. An image that cannot be read does not stop the others: they are listed
    at the end, with exit code 1. If no image has any keypoint the exit code is 3.

        deepdetect detect photo.jpg
        deepdetect detect photos/ -o keypoints --detector points --spread grid
        deepdetect detect photo.jpg --density 0.1 --format csv

    Args:
        ignore: Mask image of the same size: no keypoints where it is bright.
        pictures: Write pictures, too.
    """
    import_opencv()  # what is missing is said before anything is written
    folder = cli.output_folder(output)
    paths = cli.expand_images(images, folder)
    drawn = ("keypoints", "dense", "heatmap") if detector == "network" else ("keypoints",)
    outputs = {
        path: {"file": folder / f"{path.stem}.{file_format}"}
        | {name: folder / f"{path.stem}_{name}.jpg" for name in drawn if pictures}
        for path in paths
    }
    cli.check_inputs_survive([file for files in outputs.values() for file in files.values()], paths)
    mask = None if ignore is None else load_mask(ignore)
    given = {*values}
    chosen, selection = chosen_detector(detector, values)
    if detector == "network" and "max_keypoints" in given:
        cli.note("these are the best pixels of the heat map: --detector points finds better points")
    settings = plain(
        chosen.settings
        | vars(selection or SelectionOptions())
        | {"ignore": mask, "version": __version__}
    )
    _check_and_say_what_is_replaced(outputs, settings, overwrite)
    results: list[dict[str, Any]] = []
    failures: list[str] = []
    with progress(len(paths), "detecting", "image", quiet=len(paths) == 1) as bar:
        for path, files in outputs.items():
            try:
                results.append(
                    _detect_one(path, files, chosen, selection, mask, settings, overwrite)
                )
            except _Failure as failure:
                failures.append(str(failure))
            except MemoryError:
                failures.append(f"{path}: there is not enough memory for it: use a smaller image")
            bar.update(1)
    if as_json:
        backend = getattr(chosen, "runtime", None)
        cli.print_json({"backend": backend, "images": results, "failures": failures})
    else:
        for result in results:
            how = "already done" if result["skipped"] else f"{result['seconds']:.2f} s"
            count = result["keypoints"]
            found = f"{count:,} keypoint{'' if count == 1 else 's'}"
            if detector == "network":  # else the number was asked for
                found += f", density {result['density']:.3f}"
            print(f"{result['image']}: {found}, {how} -> {result['file']}")
    cli.report_failures(failures, len(paths))
    if not any(result["keypoints"] for result in results):
        cli.note("no keypoint was found: the image is uniform, or the options leave none")
        return cli.NOTHING_FOUND
    return 0


class _Failure(Exception):
    """One image cannot be worked on; whatever else is raised concerns all of them."""


def _check_and_say_what_is_replaced(
    outputs: dict[Path, dict[str, Path]], settings: dict[str, Any], overwrite: bool
) -> None:
    """Refuse outputs of other images; name the options in which earlier ones differ."""
    changed, names = [], set()
    for path, files in outputs.items():
        Outputs([*files.values()], [path], overwrite=overwrite).find()
        before = Outputs([files["file"]], [path], overwrite=overwrite).find()
        if before is not None and before["settings"] != settings:
            both = {**before["settings"], **settings}
            names |= {n for n in both if before["settings"].get(n) != settings.get(n)}
            changed.append(path)
    if changed:
        names = {"detector"} if "detector" in names else names
        flags = ", ".join("--" + name.replace("_", "-") for name in sorted(names))
        whose = str(changed[0]) if len(changed) == 1 else f"{len(changed)} images"
        cli.note(f"replacing the results of {whose} with other options ({flags})")


def _detect_one(
    path: Path,
    files: dict[str, Path],
    detector: DeepDetect | PointDetector,
    selection: SelectionOptions | None,
    mask: np.ndarray | None,
    settings: dict[str, Any],
    overwrite: bool,
) -> dict[str, Any]:
    """Detect, save and draw the keypoints of one image unless it is done; return its numbers."""
    shown = {"file": files["file"], "pictures": {n: files[n] for n in files if n != "file"}}
    outputs = Outputs([*files.values()], [path], overwrite=overwrite)
    done = outputs.find()  # another command may have done it meanwhile
    if done is not None and done["settings"] == settings:
        return {"image": path, **done["numbers"], **shown, "skipped": True}
    before = Outputs([files["file"]], [path]).find() or {} if not overwrite else {}
    try:
        started = time.perf_counter()
        rgb = load_image(path)
        if "dense" in files and isinstance(detector, DeepDetect):  # the network is run once
            heatmap, logits = detector.heatmap_and_logits(rgb)
            keypoints = select_keypoints(
                heatmap, selection or SelectionOptions(), logits, ignore=mask
            )
        else:
            keypoints = find_keypoints(detector, rgb, selection, mask)
        seconds = time.perf_counter() - started
    except (MissingExtraError, WeightsError):  # concern all images
        raise
    except DeepDetectError as error:
        named = str(error) if str(path) in str(error) else f"{path}: {error}"
        raise _Failure(named) from error
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
        noted |= {
            "numbers": numbers,
            "settings": settings,
            "files": [f.name for f in outputs.paths],
        }
    for name in before.get("files", ()):  # of other options
        old = files["file"].with_name(name)
        with contextlib.suppress(OptionError):  # it has been changed since
            if old not in outputs.paths and Outputs([old], [path]).find():
                old.unlink()
    return {"image": path, **numbers, **shown, "skipped": False}
