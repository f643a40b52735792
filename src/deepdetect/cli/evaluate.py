"""`deepdetect evaluate`: how good weights are."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from .._shared.errors import BatchError, OptionError
from ..datasets.oxford import load_oxford
from ..detector.detector import DeepDetect
from ..detector.heatmap import HeatmapOptions
from ..evaluation.options import PAPER_RESOLUTION_PX
from ..evaluation.protocols.masks import LabelDetector
from ..evaluation.weights import Evaluation, OxfordScore, evaluate_oxford
from ..evaluation.weights import evaluate as run
from ._detection import NETWORK
from ._options import Json, print_json, with_options

WIDTH = 14


@with_options(NETWORK)
def evaluate(
    samples: Annotated[Path, Parameter(help="Folder of image_NAME.png with mask_image_NAME.png.")],
    /,
    *,
    compare: list[str] | None = None,
    oxford: Path | None = None,
    labels: bool = False,
    foreground: Path | None = None,
    equal_density: bool = False,
    scale: list[float] | None = None,
    as_json: Json = False,
    **values: Any,
) -> None:
    """Score the network on a folder of images with known masks.

    Prints the mean binary cross-entropy (BCE) and intersection over union (IoU), the expected
    calibration error over all pixels, and the density of keypoints at 0.5 and of the masks,
    separately for normal and for low-visibility images; with --oxford also what the paper's
    protocol gives: images squashed to 480x480, FLANN (mean of three seeds, of 64 where fewer than
    1,000 matches are correct), ratio 0.99, correct under 1 px; with --labels also what the
    labels give there, and with --equal-density at the labels' number of keypoints. With --scale,
    whether the quality holds on larger and smaller images; SAMPLES may then be images without
    masks.

    Samples that cannot be read, and images of --oxford and --foreground that cannot be measured,
    are listed at the end, with exit code 1, and are in no score.

        deepdetect evaluate samples/
        deepdetect evaluate samples/ --weights run/deepdetect.onnx --compare other.onnx
        deepdetect evaluate samples/ --scale 0.5 --scale 1 --scale 2
        deepdetect evaluate photos/ --scale 1
        deepdetect evaluate samples/ --oxford oxford/ --equal-density --compare other.onnx

    Args:
        compare: Evaluate these weights too, beside the first; may be repeated.
        oxford: Folder of the eight Oxford scenes: measure density, repeatability and correct
            matches on them, too.
        labels: With --oxford: measure the labels too, which weights without error would give.
        foreground: Folder of images NAME.jpg and NAME_mask.png: measure the fraction of the
            keypoints on the foreground, too.
        equal_density: With --oxford and --foreground: of each image take as many keypoints as its
            label marks, not those above 0.5, so that weights which mark more have no advantage.
        scale: Score the images scaled by this factor too, on labels of their own; may be repeated.
    """
    if labels and oxford is None:
        raise OptionError("--labels measures on the Oxford scenes: name their folder with --oxford")
    scenes = load_oxford(oxford) if oxford is not None else []  # before hours of work
    weights = [values.pop("weights", "default"), *(compare or ())]
    detectors = [DeepDetect(path, **values) for path in weights]
    found = [
        run(
            detector,
            samples=samples,
            scales=tuple(scale or ()),
            oxford=oxford,
            foreground=foreground,
            equal_density=equal_density,
            quiet=as_json,
        )
        for detector in detectors
    ]
    names = _short_names(detectors)
    on_oxford = [each.oxford for each in found if each.oxford is not None]
    if labels:
        squashed = LabelDetector(heatmap_options=HeatmapOptions(PAPER_RESOLUTION_PX))
        on_oxford.append(evaluate_oxford(squashed, scenes, quiet=as_json))
    if as_json:
        results = [
            {"weights": detector.weights, "backend": detector.runtime, **_values(evaluation)}
            for detector, evaluation in zip(detectors, found, strict=True)
        ]
        further: dict[str, Any] = {"compare": results[1:]} if compare else {}
        if labels:
            further["labels"] = {"oxford": asdict(on_oxford[-1])}
        print_json({**results[0], **further})
    else:
        _print_scores(names, found)
        if scale:
            if found[0].masks:
                print()
            _print_scales(names, found)
        if on_oxford:
            print()
            columns = [*names, "labels"] if labels else names
            _print_oxford(columns, on_oxford, equal_density)
        if foreground is not None:
            print()
            _print_foreground(names, found)
    _report_failures(found, on_oxford)


def _report_failures(found: Sequence[Evaluation], on_oxford: Sequence[OxfordScore]) -> None:
    """Raise a BatchError when something is in no score; what all weights lack is listed once."""
    samples = found[0].failures
    lists = [each.failures for each in on_oxford]
    lists += [each.foreground.failures for each in found if each.foreground is not None]
    parts = list(dict.fromkeys(failure for listed in lists for failure in listed))
    if parts:
        count = len(samples) + len(parts)
        what = "one part" if count == 1 else f"{count} parts"
        summary = f"{what} could not be measured, the scores are of the rest"
        raise BatchError(summary, [*samples, *parts])
    if samples:
        scales = found[0].scales
        rows = [row.score for row in scales if row.scale == scales[0].scale]
        scored = sum(score.images for score in found[0].masks.values() or rows)
        total = len(samples) + scored
        raise BatchError(f"{len(samples)} of {total} samples are not in the scores", samples)


def _values(evaluation: Evaluation) -> dict[str, Any]:
    """Return an evaluation as plain values for JSON."""
    values: dict[str, Any] = {
        name: {**asdict(score), **evaluation.calibration[name].values()}
        for name, score in evaluation.masks.items()
    }
    if evaluation.scales:
        values["scales"] = [
            {
                "scale": row.scale,
                "visibility": row.visibility,
                "score": asdict(row.score),
                **row.calibration.values(),
            }
            for row in evaluation.scales
        ]
    if evaluation.oxford is not None:
        values["oxford"] = asdict(evaluation.oxford)
    if evaluation.foreground is not None:
        values["foreground"] = asdict(evaluation.foreground)
    return values


def _short_names(detectors: Sequence[Any]) -> list[str]:
    """Return names that fit a table: the files', with their folders where they are the same."""
    paths = [detector.weights for detector in detectors]
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = [f"{path.parent.name}/{path.stem}" for path in paths]
    return [name if len(name) <= 2 * WIDTH else f"...{name[3 - 2 * WIDTH :]}" for name in names]


def _row(title: str, values: Sequence[str]) -> None:
    print(f"{title:<24}" + "".join(f"{value:>{2 * WIDTH + 2}}" for value in values))


def _print_scores(names: Sequence[str], found: Sequence[Evaluation]) -> None:
    if not found[0].masks:
        return
    if len(names) == 1:
        titles = {"images": 8, "BCE": 9, "IoU": 8, "calibration error": 19, "density": 9}
        head = "".join(f"{title:>{width}}" for title, width in titles.items())
        print(f"{'visibility':<12}{head}  labels'")
        for name, score in found[0].masks.items():
            pixels = found[0].calibration[name]
            print(
                f"{name:<12}{score.images:>8}{score.loss:>9.4f}{score.iou:>8.3f}"
                f"{pixels.expected_error:>19.4f}{pixels.density:>9.4f}{pixels.label_density:>9.4f}"
            )
        return
    _row("known masks, BCE / IoU", names)
    for name, score in found[0].masks.items():
        scores = [each.masks[name] for each in found]
        cells = [f"{score.loss:.4f} / {score.iou:.3f}" for score in scores]
        _row(f"  {name} ({score.images} images)", cells)
    _row("calibration error (density)", names)
    for name in found[0].masks:
        calibrations = [each.calibration[name] for each in found]
        title = f"  {name} ({calibrations[0].label_density:.4f})"
        _row(title, [f"{each.expected_error:.4f} ({each.density:.4f})" for each in calibrations])


def _print_scales(names: Sequence[str], found: Sequence[Evaluation]) -> None:
    _row("scales, BCE / IoU, calibration error (density)", names)
    for rows in zip(*(each.scales for each in found), strict=True):
        title = f"  x{rows[0].scale:g} {rows[0].visibility} ({rows[0].label_density:.3f})"
        cells = [
            f"{r.score.loss:.3f} / {r.score.iou:.3f}, {r.calibration.expected_error:.3f} "
            f"({r.density:.3f})"
            for r in rows
        ]
        _row(title, cells)


def _print_oxford(names: Sequence[str], found: Sequence[OxfordScore], equal_density: bool) -> None:
    _row("Oxford, density", names)
    for threshold in found[0].density:
        title = "  that of the labels" if equal_density else f"  tau {threshold}"
        _row(title, [f"{each.density[threshold]:.4f}" for each in found])
    _row("repeatability at 1 px", names)
    for scene in _names(each.repeatability for each in found):
        _row(f"  {scene}", [_decimals(each.repeatability.get(scene)) for each in found])
    _row("  mean", [_decimals(_mean(each.repeatability.values())) for each in found])
    _row("correct matches of all", names)
    for pair in _names(each.correct for each in found):
        cells = [(each.correct.get(pair), each.matches.get(pair)) for each in found]
        _row(f"  {pair}", ["-" if a is None else f"{a:,} / {b:,}" for a, b in cells])


def _names(found: Iterable[Iterable[str]]) -> list[str]:
    """Return what any of the weights was measured on, each once."""
    return list(dict.fromkeys(name for names in found for name in names))


def _mean(values: Collection[float]) -> float | None:
    return sum(values) / len(values) if values else None


def _decimals(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"


def _print_foreground(names: Sequence[str], found: Sequence[Evaluation]) -> None:
    scores = [each.foreground for each in found if each.foreground is not None]
    _row("on the foreground", names)
    _row("  fraction (density)", [f"{each.fraction:.4f} ({each.density:.4f})" for each in scores])
    _row("  of random keypoints", [f"{each.covered:.4f}" for each in scores])
