"""`deepdetect evaluate`: how good weights are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from .shared import PATH, detector_options, json_option, make_detector, print_json

if TYPE_CHECKING:
    from ..datasets.types import PlanarScene
    from ..detector.detector import DeepDetect
    from ..evaluation.mask_scores import MaskScore
    from ..evaluation.scale_quality import ScaleQuality
    from ..evaluation.weights_quality import OxfordQuality

WIDTH = 12


@click.command(short_help="How good weights are.")
@click.argument("samples", type=PATH)
@detector_options
@click.option(
    "--against",
    multiple=True,
    metavar="NAME|FILE",
    help="Measure these weights too, beside the first; may be repeated.",
)
@click.option(
    "--oxford",
    type=PATH,
    metavar="FOLDER",
    help="Measure density, repeatability and correct matches on the eight Oxford scenes too.",
)
@click.option(
    "--labels",
    is_flag=True,
    help="With --oxford: measure the labels too, which weights without error would give.",
)
@click.option(
    "--scale",
    "scales",
    type=float,
    multiple=True,
    metavar="FACTOR",
    help="Score the images scaled by this factor too, on labels made anew; may be repeated.",
)
@json_option
def evaluate(
    samples: Path,
    against: tuple[str, ...],
    oxford: Path | None,
    labels: bool,
    scales: tuple[float, ...],
    as_json: bool,
    **values: Any,
) -> None:
    """Score the network on a folder SAMPLES of image_NAME.png with mask_image_NAME.png.

    Prints the mean binary cross-entropy (BCE) and intersection over union (IoU), apart
    for normal and for low-visibility images; with --oxford also what the paper's protocol
    gives: images squashed to 480x480, FLANN (mean of three seeds, of 64 where fewer than
    1,000 matches are correct), ratio 0.99, correct under 1 px; with --labels also what the
    labels give there. With --scale, whether the quality holds on larger and smaller images.

    \b
    deepdetect evaluate samples/
    deepdetect evaluate samples/ --weights run/deepdetect.onnx --against other.onnx
    deepdetect evaluate samples/ --scale 0.5 --scale 1 --scale 2
    """
    from .._shared.errors import OptionError
    from ..datasets.oxford import load_oxford
    from ..evaluation.mask_scores import score_samples
    from ..evaluation.scale_quality import check_scales

    check_scales(scales)
    if labels and oxford is None:
        raise OptionError("--labels measures on the Oxford scenes: name their folder with --oxford")
    scenes = load_oxford(oxford) if oxford is not None else []
    weights = [values["weights"], *against]
    detectors = [make_detector({**values, "weights": path}) for path in weights]
    scores = [score_samples(each.heatmap, samples, quiet=as_json) for each in detectors]
    at_scales = _measure_scales(detectors, samples, scales, as_json) if scales else []
    on_oxford = _measure_oxford(detectors, labels, scenes, as_json) if scenes else []
    if as_json:
        results = []
        for k, (detector, score) in enumerate(zip(detectors, scores, strict=True)):
            result = {
                "weights": detector.weights,
                "backend": detector.backend,
                **{name: asdict(value) for name, value in score.items()},
            }
            if at_scales:
                result["scales"] = [asdict(row) for row in at_scales[k]]
            if on_oxford:
                result["oxford"] = asdict(on_oxford[k])
            results.append(result)
        further: dict[str, Any] = {"against": results[1:]} if against else {}
        if labels:
            further["labels"] = {"oxford": asdict(on_oxford[-1])}
        print_json({**results[0], **further})
        return
    names = _short_names([detector.weights for detector in detectors])
    _print_scores(names, scores)
    if at_scales:
        click.echo()
        _print_scales(names, at_scales)
    if on_oxford:
        click.echo()
        _print_oxford([*names, "labels"] if labels else names, on_oxford)


def _measure_oxford(
    detectors: Sequence[DeepDetect], labels: bool, scenes: list[PlanarScene], quiet: bool
) -> list[OxfordQuality]:
    from .._shared.progress import progress
    from ..evaluation.weights_quality import LabelMasks, oxford_quality, oxford_steps

    rows = [*detectors, LabelMasks()] if labels else detectors
    with progress(oxford_steps(scenes) * len(rows), "Oxford", "step", quiet) as bar:
        return [oxford_quality(row, scenes, bar.update) for row in rows]


def _measure_scales(
    detectors: Sequence[DeepDetect], samples: Path, scales: Sequence[float], quiet: bool
) -> list[list[ScaleQuality]]:
    from .._shared.progress import progress
    from ..evaluation.mask_scores import sample_images
    from ..evaluation.scale_quality import scale_quality

    images = sample_images(samples)
    with progress(len(images) * len(scales), "scales", "image", quiet) as bar:
        return scale_quality(detectors, images, scales, done=bar.update)


def _short_names(paths: Sequence[Path]) -> list[str]:
    """Return names that fit a table: the files', with their folders when they are alike."""
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [f"{path.parent.name}/{path.stem}" for path in paths]
    return [name if len(name) <= 2 * WIDTH else f"...{name[3 - 2 * WIDTH :]}" for name in names]


def _row(title: str, values: Sequence[str]) -> None:
    click.echo(f"{title:<24}" + "".join(f"{value:>{2 * WIDTH + 2}}" for value in values))


def _print_scores(names: Sequence[str], scores: Sequence[dict[str, MaskScore]]) -> None:
    if len(names) == 1:
        click.echo(f"{'visibility':<12}{'images':>8}{'BCE':>9}{'IoU':>8}")
        for name, score in scores[0].items():
            click.echo(f"{name:<12}{score.images:>8}{score.loss:>9.4f}{score.iou:>8.3f}")
        return
    _row("known masks, BCE / IoU", names)
    for visibility, score in scores[0].items():
        cells = [f"{each[visibility].loss:.4f} / {each[visibility].iou:.3f}" for each in scores]
        _row(f"  {visibility} ({score.images} images)", cells)


def _print_scales(names: Sequence[str], found: Sequence[list[ScaleQuality]]) -> None:
    _row("scales, BCE / IoU (density)", names)
    for rows in zip(*found, strict=True):
        title = f"  x{rows[0].scale:g} {rows[0].visibility} ({rows[0].label_density:.3f})"
        _row(title, [f"{r.score.loss:.3f} / {r.score.iou:.3f} ({r.density:.3f})" for r in rows])


def _print_oxford(names: Sequence[str], found: Sequence[OxfordQuality]) -> None:
    _row("Oxford, density", names)
    for threshold in found[0].density:
        _row(f"  tau {threshold}", [f"{each.density[threshold]:.4f}" for each in found])
    _row("repeatability at 1 px", names)
    for scene in found[0].repeatability:
        _row(f"  {scene}", [f"{each.repeatability[scene]:.4f}" for each in found])
    means = [sum(each.repeatability.values()) / len(each.repeatability) for each in found]
    _row("  mean", [f"{mean:.4f}" for mean in means])
    _row("correct matches of all", names)
    for pair in found[0].correct:
        _row(f"  {pair}", [f"{each.correct[pair]:,} / {each.matches[pair]:,}" for each in found])
