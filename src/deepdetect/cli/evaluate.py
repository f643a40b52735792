"""`deepdetect evaluate`: how good weights are."""

from __future__ import annotations

from collections.abc import Sequence
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
from ._options import Json, print_columns, print_json, with_options


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
    on_oxford = [each.oxford for each in found if each.oxford is not None]
    results = [
        {"weights": detector.weights, "backend": detector.runtime, **_values(evaluation)}
        for detector, evaluation in zip(detectors, found, strict=True)
    ]
    further: dict[str, Any] = {"compare": results[1:]} if compare else {}
    if labels:
        squashed = LabelDetector(heatmap_options=HeatmapOptions(PAPER_RESOLUTION_PX))
        on_oxford.append(evaluate_oxford(squashed, scenes, quiet=as_json))
        further["labels"] = {"oxford": asdict(on_oxford[-1])}
    if as_json:
        print_json({**results[0], **further})
    else:
        columns = [*results, *([{"weights": "labels", **further["labels"]}] if labels else [])]
        for each in columns:
            rows = each.pop("scales", ())
            each |= {f"x{row['scale']:g} {row['visibility']}": row for row in rows}
        print_columns(columns)
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
        first = [score for (scale, _), score in scales.items() if scale == min(scales)[0]]
        scored = sum(score.images for score in found[0].masks.values() or first)
        total = len(samples) + scored
        raise BatchError(f"{len(samples)} of {total} samples are not in the scores", samples)


def _values(evaluation: Evaluation) -> dict[str, Any]:
    """Return an evaluation as plain values for JSON."""
    values: dict[str, Any] = {name: asdict(score) for name, score in evaluation.masks.items()}
    if evaluation.scales:
        values["scales"] = [
            {"scale": scale, "visibility": visibility, **asdict(score)}
            for (scale, visibility), score in evaluation.scales.items()
        ]
    if evaluation.oxford is not None:
        values["oxford"] = asdict(evaluation.oxford)
    if evaluation.foreground is not None:
        values["foreground"] = asdict(evaluation.foreground)
    return values
