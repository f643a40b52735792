"""`deepdetect match`, `register` and `stitch`: overlapping images."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter

from .._shared.errors import ImageError, OptionError, noted_failures
from .._shared.image_array import array_to_rgb
from .._shared.progress import StageTimer, progress, stage_progress
from ..batch.pair_list import list_pairs
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.matchers import MATCHERS_OF_NUMBERS
from ..features.matches import Matches
from ..features.pictures import draw_all_matches
from ..features.selection import SelectionOptions
from ..geometry import GeometryOptions, estimate_geometry
from ..geometry.estimation import MODEL_NAMES
from ..geometry.transforms import translation_matrix
from ..io.image import load_image, load_pixels, one_range
from ..io.image_file import reading_options
from ..io.picture_file import Metadata, picture_suffix, read_metadata, save_picture
from ..io.projection import require_pinhole
from ..io.tables import read_matrix, save_matches
from ..matching.pipeline import GUIDED_STAGES, match_features, match_images
from ..matching.refinement import refine_matches
from ..matching.registration import register as register_images
from ..matching.stitching import StitchingOptions, stages_of
from ..matching.stitching import stitch as stitch_images
from . import _options as cli
from ._detection import (
    DESCRIBED_POINTS,
    NETWORK,
    POINTS,
    SELECTION,
    Detector,
    chosen_detector,
)

PAIR = cli.From(match_images, "model mutual", more="seed", types={"model": Literal[MODEL_NAMES]})
UNGUIDED = cli.From(
    match_features, more="matcher filter_by ratio", types={"matcher": Literal[MATCHERS_OF_NUMBERS]}
)
UNGUIDED_STAGES = ("keypoints", "matching", "geometry")

GEOMETRY = cli.From(GeometryOptions, more="inlier_threshold confidence iterations")
REGISTRATION = cli.From(register_images, "extent", more="mutual seed")
PANORAMA = cli.From(stitch_images, "projection crop force", more="seed")
OPTIONS = cli.From(StitchingOptions)
STITCH_KEYPOINTS = cli.From(PointDetector, more="max_keypoints")


@cli.command(PAIR, SELECTION, UNGUIDED, GEOMETRY, DESCRIBED_POINTS, NETWORK, cli.READING)
def match(
    *images: cli.Images,
    output: cli.Folder = Path("deepdetect-output"),
    pairs: str = "exhaustive",
    detector: Detector = "network",
    unguided: Annotated[bool, Parameter(negative="")] = False,
    refine: Annotated[bool, Parameter(negative="")] = False,
    homography: cli.More[Path | None] = None,
    camera0: cli.More[Path | None] = None,
    camera1: cli.More[Path | None] = None,
    file_format: cli.Format = "npz",
    pictures: bool = True,
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Match the keypoints of two images, or of pairs of more images.

    Writes STEM0_STEM1_matches.npz (or .csv) with the matched positions, their scores, the
    estimated geometry and its inliers, and a visualisation. The options --descriptor, --matcher,
    --filter-by and --ratio are for --unguided. The exit code is 3 if nothing matches, or if no
    geometry between the images can be trusted.

        deepdetect match left.jpg right.jpg
        deepdetect match page1.jpg page2.jpg --model homography --mutual
        deepdetect match left.jpg right.jpg --unguided --detector points --ratio 0.9
        deepdetect match frames/ --pairs sequential:1

    Args:
        pairs: Which of more than two images to match: exhaustive (all pairs), sequential:1 (each
            image with the next by name), or a text file with the names of two images on each line.
        unguided: Match by descriptors alone over the whole image, then estimate a geometry.
        refine: Align the image around each match, to move it to a fraction of a pixel.
        homography: Text file with a known 3x3 homography from the first image to the second.
            Matches that agree with it are the inliers.
        camera0: Text file with the 3x3 intrinsic matrix of camera 0, for --model essential.
        camera1: Text file with the 3x3 intrinsic matrix of camera 1.  [default: camera0]
        pictures: Also write a visualisation.
    """
    many = len(images) != 2 or any(path.is_dir() for path in images)
    endings = {"file": f".{file_format}"} | ({"picture": ".jpg"} if pictures else {})
    outputs = {
        pair: cli.output_files(output, f"{stem}_matches", endings)
        for pair, stem in _choose_pairs(images, pairs if many else None, output).items()
    }
    inputs = [path for pair in outputs for path in pair]
    cli.check_outputs([path for files in outputs.values() for path in files.values()], inputs)
    by_descriptors = UNGUIDED.take(values)
    for name in () if unguided else (*by_descriptors, *({"descriptor"} & values.keys())):
        raise OptionError(f"`{name}` is for --unguided: add that option, or leave `{name}` out")
    chosen, selection = chosen_detector(detector, values, options=DESCRIBED_POINTS)
    matrices = {"homography": homography, "camera0": camera0, "camera1": camera1 or camera0}
    known: dict[str, Any] = {
        name: read_matrix(path) for name, path in matrices.items() if path is not None
    }
    geometry = GeometryOptions(**known, **GEOMETRY.take(values))
    match_pair: Callable[..., Matches] = match_images
    if unguided:
        match_pair = partial(_match_unguided, refine=refine, **by_descriptors)
    stages = UNGUIDED_STAGES if unguided else GUIDED_STAGES[detector == "points" :]
    of_pinholes = partial(_load_of_pinhole, rim=unguided)
    flat = values.get("model") == "homography"
    load = lru_cache(2)(load_pixels if flat else of_pinholes)  # successive pairs share an image
    found: list[dict[str, Any]] = []
    failures: list[str] = []
    seen = [*dict.fromkeys(inputs)]
    with one_range(seen), progress(len(outputs), "matching", "pair", quiet=not many) as bar:
        for pair, files in outputs.items():
            name = " ".join(map(str, pair)) if many else ""
            with noted_failures(name, failures):
                with cli.writing(files, pair, overwrite) as made:
                    rgb0, rgb1 = map(load, pair)
                    with stage_progress("matching", stages, quiet=many) as done:
                        settings = values | {"options": geometry, "progress": done}
                        try:
                            matches = match_pair(
                                rgb0, rgb1, chosen, selection=selection, **settings
                            )
                            if refine and not unguided:
                                matches = refine_matches(rgb0, rgb1, matches)
                        except ImageError as error:
                            raise ImageError(_named(error, pair)) from error
                    save_matches(matches, made["file"])
                    if pictures:
                        save_picture(draw_all_matches(rgb0, rgb1, matches), made["picture"])
                if reason := _why_none(matches, unguided):
                    cli.say(f"{name}: {reason}" if many else reason)
                numbers = _numbers(pair, matches, files)
                found.append(numbers | {"backend": getattr(chosen, "runtime", None)})
            bar.update(1)
    nothing = not (failures or any(each["matches"] and each["success"] for each in found))
    one = not many and not failures
    names = "keypoints0 keypoints1 one_to_one seconds file picture"
    return cli.Result(
        found[0] if one else {"pairs": found, "failures": failures},
        cli.headed(_headline(found[0]), found[0], names) if one else "\n".join(map(_line, found)),
        failures,
        len(outputs),
        "pairs",
        cli.NOTHING_FOUND if nothing else 0,
    )


def _named(text: object, images: Sequence[Path]) -> str:
    """Replace each `images[N]` in a message by the path of that image."""
    return re.sub(r"images\[(\d+)\]", lambda found: str(images[int(found[1])]), str(text))


def _load_of_pinhole(path: Path, rim: bool) -> np.ndarray:
    pixels = load_pixels(path)
    require_pinhole(path, pixels[:, :, :3], rim=rim)
    return pixels


def _match_unguided(
    image0: np.ndarray,
    image1: np.ndarray,
    detector: DeepDetect | PointDetector,
    *,
    selection: SelectionOptions | None,
    options: GeometryOptions,
    progress: Callable[[str], object],
    model: str = "auto",
    seed: int = 0,
    refine: bool = False,
    **values: Any,
) -> Matches:
    timer = StageTimer(progress)
    with timer.stage("keypoints"):
        chosen = {} if selection is None else vars(selection)
        features = [detector.extract(image, **chosen) for image in (image0, image1)]
    with timer.stage("matching"):
        matches = match_features(*features, seed=seed, **values)
        if refine:
            matches = refine_matches(image0, image1, matches)
    with timer.stage("geometry"):
        found = estimate_geometry(matches, model=model, seed=seed, options=options)
        matches = matches.with_geometry(found, options.inlier_threshold)
    return replace(matches, seconds=timer.seconds)


def _headline(found: dict[str, Any]) -> str:
    if not found["matches"]:
        return "no matches"
    text = f"{found['matches']:,} matches"
    geometry = found["geometry"]
    if not found["success"]:
        return f"{text}; no geometry can be trusted"
    fits = found["inliers"] / found["matches"]
    text += f", {fits:.0%} of them agree with one geometry ({geometry['model']})"
    return f"{text}; scene: {geometry['scene']}; confidence: {geometry['confidence']}"


def _line(found: dict[str, Any]) -> str:
    return f"{found['image0']} {found['image1']}: {_headline(found)} -> {found['file']}"


def _choose_pairs(
    images: Sequence[Path], pairs: str | None, output: Path
) -> dict[tuple[Path, Path], str]:
    """Return the chosen pairs, each with the stem of its result files."""
    if pairs is None:
        return {(images[0], images[1]): f"{images[0].stem}_{images[1].stem}"}
    paths = cli.expand_images(images, output)
    wanted = list_pairs(pairs, [*paths])
    for name in {name for pair in wanted for name in pair} - paths.keys():
        raise OptionError(
            f"{name} in {pairs} is not one of the images: give its path relative to the folder"
        )
    if not wanted:
        load_image(min(paths.values()))  # raises an error with advice if it is a video
        raise OptionError("one image makes no pair: give two or more images, or a folder")
    stems = {path: stem.replace("/", "-") for path, stem in cli.result_stems(paths).items()}
    chosen = [(paths[name0], paths[name1]) for name0, name1 in wanted]
    return {pair: f"{stems[pair[0]]}_{stems[pair[1]]}" for pair in chosen}


def _why_none(matches: Matches, unguided: bool) -> str | None:
    """Return a sentence that says why there are no matches or no geometry; None if there are."""
    if not len(matches) and (matches.success or unguided):
        return "there are no matches: the images have too little texture, or the options allow none"
    if matches.success:
        return None
    if len(matches):
        return "no geometry can be trusted: most of these matches by descriptors may be wrong"
    return (
        "no geometry between these images can be trusted, so there are no matches: if they show "
        "the same scene, try --unguided, which matches by descriptors alone"
    )


def _numbers(
    pair: tuple[Path, Path], matches: Matches, files: Mapping[str, Path]
) -> dict[str, Any]:
    return {
        "image0": pair[0],
        "image1": pair[1],
        "keypoints0": len(matches.keypoints0),
        "keypoints1": len(matches.keypoints1),
        "density0": round(matches.keypoints0.density, 6),
        "density1": round(matches.keypoints1.density, 6),
        "matches": len(matches),
        "inliers": int(matches.inliers.sum()),
        "one_to_one": len(matches.unique()),
        "success": matches.success,
        "geometry": _geometry_values(matches),
        "seconds": {stage: round(value, 4) for stage, value in matches.seconds.items()},
        "file": files["file"],
        "picture": files.get("picture"),
    }


def _geometry_values(matches: Matches) -> dict[str, Any] | None:
    if (geometry := matches.geometry) is None:
        return None
    nfa = geometry.evidence.log10_nfa  # JSON has no infinity
    evidence = vars(geometry.evidence) | {"log10_nfa": nfa if math.isfinite(nfa) else None}
    matrix = None if geometry.matrix is None else geometry.matrix.tolist()
    layers = [
        {
            "model": each.model,
            "matrix": each.matrix.tolist(),
            "share": round(each.share, 4),
            "matches": int(np.count_nonzero(matches.layer == number)),
        }
        for number, each in enumerate(geometry.layers)
    ]
    return vars(geometry) | {"matrix": matrix, "evidence": evidence, "layers": layers}


@cli.command(REGISTRATION, SELECTION, POINTS, NETWORK, cli.READING)
def register(
    image0: cli.Image,
    image1: cli.Image,
    /,
    *,
    output: cli.Folder = Path("deepdetect-output"),
    detector: Detector = "network",
    apply_to: tuple[Path, ...] = (),
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Register the second image to the first, if both show one plane or were taken from one place.

    Writes STEM1_on_STEM0.png (the second image warped into the frame of the first), both images
    combined as _checkerboard.png and _difference.png, and _homography.txt (3x3, from the first
    image to the second). The results keep the georeference, the colour profile and the EXIF of the
    first image. If the first image is a GeoTIFF, or the second is not a plain grey or RGB image,
    the warped image is a TIFF with all bands of the second image, in their own data type.

        deepdetect register map.jpg photo-of-the-map.jpg -o registered
        deepdetect register ortho.tif drone.tif --bands 3 2 1 --extent union --apply-to thermal.tif

    Args:
        apply_to: More images to warp, with the size and view of the second, such as thermal bands.
    """
    reference, folder = read_metadata(image0, placed=True), cli.output_folder(output)
    own = {path: read_metadata(path) for path in (image1, *apply_to)}
    files: dict[Any, Path] = {}
    geotiff = reference.to_world is not None and image0.suffix.lower() in (".tif", ".tiff")
    for path, each in own.items():
        ending = ".png" if each.plain and not geotiff else ".tif"
        files[path] = folder / f"{path.stem}_on_{image0.stem}{ending}"
    for ending in ("_checkerboard.png", "_difference.png", "_homography.txt"):
        files[ending] = folder / f"{image1.stem}_on_{image0.stem}{ending}"
    chosen, selection = chosen_detector(detector, values)
    values |= {"selection": selection, "apply_to": [*own]}
    with cli.writing(files, [image0, *own], overwrite) as made:
        with stage_progress("registering", GUIDED_STAGES[detector == "points" :]) as done:
            found = register_images(image0, image1, chosen, progress=done, **values)
        moved = reference.moved(translation_matrix(*-np.array(found.origin)))
        for (path, each), bands in zip(own.items(), found.applied, strict=True):
            kept = replace(moved, profile=each.profile or moved.profile, no_data=each.no_data)
            if files[path].suffix == ".tif":
                kept.write_tiff(bands, made[path])
            else:
                every = (0, 65535) if bands.dtype == np.uint16 else None  # keeps uint16 values
                rgb = array_to_rgb(bands[:, :, :3], value_range=every, deep=True)
                rgb[(bands[:, :, 3:] == 0).any(axis=2)] = 0  # blackens transparent pixels
                rgb = found.warped if path == image1 else rgb
                save_picture(rgb, made[path], kept)
            kept.write_beside(files[path])
        save_picture(found.checkerboard(), made["_checkerboard.png"])
        save_picture(found.difference(), made["_difference.png"])
        np.savetxt(made["_homography.txt"], found.homography, fmt="%.12e")
    numbers = {
        "image0": image0,
        "image1": image1,
        "homography": found.homography.tolist(),
        "origin": found.origin,
        "matches": found.matches,
        "overlap": round(float(found.valid.mean()), 4),
        "correlation": round(found.zncc, 4),
        "left_out": round(found.left_out, 4),
        "files": [*files.values()],
    }
    title = f"{image1.name} registered to {image0.name} by {found.matches:,} matches"
    return cli.Result(numbers, cli.headed(title, numbers, "overlap correlation files"))


@cli.command(PANORAMA, OPTIONS, STITCH_KEYPOINTS, POINTS, NETWORK, cli.READING)
def stitch(
    *sources: cli.Images,
    output: cli.Output = Path("panorama.jpg"),
    reference: Path | None = None,
    detector: Detector = "network",
    overwrite: cli.Overwrite = False,
    **values: Any,
) -> cli.Result:
    """Stitch overlapping images, taken from one place or showing one plane, to a panorama.

    The images may be in any order. Images that overlap no other, or cannot be read, are left out
    and listed, with exit code 1; if images contradict each other, nothing is written, with code 3.
    Flat panoramas cover at most 100 to 120 degrees, cylindrical or spherical ones 360.

        deepdetect stitch left.jpg middle.jpg right.jpg -o panorama.jpg
        deepdetect stitch photos/ --projection cylindrical --crop -o panorama.jpg

    Args:
        output: File of the panorama, or a folder for it.
        reference: Image that is undistorted in a flat panorama, and in the middle of a curved one.
            [default: the one in the middle]
    """
    file = cli.output_file(output, "panorama.jpg")
    paths = [*cli.expand_images(sources, file).values()]
    picture_suffix(file)  # checks the suffix before the long work
    if reference is not None and reference not in paths:
        raise OptionError(f"--reference {reference} must be one of the images: add it to them")
    if detector == "network" and "max_keypoints" in values:
        raise OptionError(
            "--max-keypoints is for --detector points: leave it out, or choose that detector"
        )
    chosen, _ = chosen_detector(detector, values)
    options = StitchingOptions(**OPTIONS.take(values))
    flat = values.get("projection", "plane") == "plane"
    images: list[Path] = []
    carried: list[Metadata] = []
    failures: list[str] = []
    for path in paths:
        with noted_failures(str(path), failures):
            require_pinhole(path, load_image(path))
            carried.append(read_metadata(path, placed=flat))
            images.append(path)
    if failures and len(paths) == 1:
        raise ImageError(failures[0])
    if len(images) < min(len(paths), 2) or (reference is not None and reference not in images):
        what = "too few images can be read, or the reference cannot"
        raise ImageError(f"there is no panorama, because {what}: {'; '.join(failures)}")
    cli.check_outputs([file], paths)

    with cli.writing({"file": file}, images, overwrite) as made:
        with stage_progress("stitching", stages_of(len(images))) as done:
            panorama = stitch_images(
                images,
                detector=chosen,
                reference=None if reference is None else images.index(reference),
                options=options,
                progress=done,
                **values,
            )
        moved = panorama.homographies[panorama.reference] if flat else None
        kept, image = carried[panorama.reference].moved(moved), panorama.image
        if file.suffix.lower() in (".tif", ".tiff"):
            image = kept.raster(image, reading_options().value_range or (0, 1))
        image, kept = kept.with_no_data(image, ~panorama.valid)
        save_picture(image, made["file"], kept, panorama.value_range)
        kept.write_beside(file)
    left = [{"image": images[k], "reason": reason} for k, reason in panorama.unregistered.items()]
    failures += [f"{each['image']} is not in the panorama: {each['reason']}" for each in left]
    if panorama.parallax:
        (first, second), distance = max(panorama.parallax.items(), key=lambda item: item[1])
        cli.say(
            f"{images[first]} and {images[second]} differ by {distance:.0f} pixels along their "
            "seam, because the camera moved: rotate it only about its lens, or avoid near objects"
        )
    height, width = panorama.valid.shape
    used = sorted(panorama.homographies)
    numbers = {
        "images": [images[k] for k in used],
        "unregistered": left,
        "reference": images[panorama.reference],
        "width": width,
        "height": height,
        "covered": round(float(panorama.valid.mean()), 4),
        "homographies": [panorama.homographies[k].tolist() for k in used],
        "gains": [round(panorama.gains[k], 4) for k in used],
        "pairs": [
            {"images": [images[first], images[second]], "matches": count}
            for (first, second), count in panorama.matches.items()
        ],
        "residual_px": round(panorama.residual_px, 4),
        "left_out": round(panorama.left_out, 4),
        "closed": panorama.closed,
        "parallax": [
            {"images": [images[first], images[second]], "pixels": round(distance, 1)}
            for (first, second), distance in panorama.parallax.items()
        ],
        "seconds": {stage: round(value, 4) for stage, value in panorama.seconds.items()},
        "file": file,
        "failures": failures,
    }
    title = f"a panorama of {len(used)} of {len(paths)} images, {width}x{height} pixels"
    text = cli.headed(title, numbers, "reference residual_px seconds file")
    return cli.Result(numbers, text, failures, len(paths))
