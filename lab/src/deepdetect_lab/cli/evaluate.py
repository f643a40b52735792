"""Commands that evaluate weights, stereo matches, clouds, detectors, and matching engines."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from deepdetect._shared.atomic import atomic_path
from deepdetect._shared.errors import DeepDetectError, OptionError, noted_failures
from deepdetect._shared.options import look_up
from deepdetect.cli import _options as cli
from deepdetect.cli._detection import NETWORK
from deepdetect.detector.detector import DeepDetect, HeatmapDetector
from deepdetect.detector.pretrained import PRETRAINED

from ..datasets import StereoPair
from ..datasets.middlebury import load_middlebury
from ..evaluation.acceptance.measure import FAMILIES, NOTE, guided, measure, summary
from ..evaluation.baselines.external import find_feature, imported
from ..evaluation.benchmarks import BENCHMARKS, run_benchmarks
from ..evaluation.masks import LabelDetector
from ..evaluation.masks import evaluate as run
from ..evaluation.options import BenchmarkOptions
from ..evaluation.protocols.dense_points import CLOUD_COLUMNS, CLOUD_NOTE
from ..evaluation.protocols.dense_points import compare_clouds as compare
from ..evaluation.protocols.stereo_matches import score_stereo_matches
from ..evaluation.report import Table
from ..labels import find_label_settings


@cli.command(NETWORK)
def evaluate(
    samples: Annotated[
        Path,
        Parameter(help="Folder of images image_NAME.png and their masks mask_image_NAME.png."),
    ],
    /,
    *,
    compare: list[str] | None = None,
    scale: list[float] | None = None,
    **values: Any,
) -> cli.Result:
    """Score the network on a folder of images with known masks.

    Prints, separately for images of normal and of low visibility: the mean binary cross-entropy
    (BCE) and intersection over union (IoU), the expected calibration error over all pixels, the
    fraction of pixels that are keypoints (probability above 0.5), and the fraction that the masks
    mark. Unreadable files are listed at the end and are not in the scores.

        deepdetect dev evaluate samples/ --weights run/deepdetect.onnx --compare other.onnx
        deepdetect dev evaluate photos/ --scale 0.5 --scale 1 --scale 2

    Args:
        compare: Further weights to evaluate, shown next to those of --weights; may be repeated.
        scale: Also score the images scaled by this factor, against labels that are made from the
            scaled images; may be repeated. The images then need no masks.
    """
    weights = [values.pop("weights", "default"), *(compare or ())]
    detectors = [DeepDetect(path, **values) for path in weights]
    found = [run(samples, each, scales=tuple(scale or ()), quiet=False) for each in detectors]
    columns, shown = [], []
    for detector, each in zip(detectors, found, strict=True):
        masks = {name: asdict(score) for name, score in each.masks.items()}
        column = {"weights": detector.weights, "backend": detector.runtime, **masks}
        scales = [
            {"scale": factor, "visibility": visibility, **asdict(score)}
            for (factor, visibility), score in each.scales.items()
        ]
        columns.append(column | ({"scales": scales} if scales else {}))
        by_name = {f"x{row['scale']:g} {row['visibility']}": row for row in scales}
        shown.append({**column, "scales": by_name})
    report = {**columns[0], **({"compare": columns[1:]} if compare else {})}
    return cli.Result(report, cli.table(*shown), list(found[0].failures), what="parts")


STEREO_COLUMNS = {
    **{"source": "", "pair": "", "density": ".3f"},
    **{"matches": ",d", "correct": ",d", "precision": ".3f"},
}


@cli.command()
def evaluate_stereo(
    *scenes: Annotated[
        Path,
        Parameter(
            help="Folders with left.png, right.png, disparity.png and calib.json.", required=True
        ),
    ],
    weights: list[str] | None = None,
    label_settings: list[str] | None = None,
) -> cli.Result:
    """Match rectified stereo pairs and evaluate the matches with the true disparity.

    Matching uses neither the rectification nor the true disparity. A match is correct if it is
    within 1 px of the ground truth. For comparison, random points of the same density, and all
    pixels, are matched in the same way.

        deepdetect dev evaluate-stereo cones/ teddy/ --weights default --weights dense
        deepdetect dev evaluate-stereo cones/ teddy/ --label-settings mine.toml

    Args:
        weights: Pretrained weights (default, dense, free or espnet), or a file; may be repeated.
        label_settings: Label settings (paper or dense), or a TOML file. Their labels are matched
            as keypoints, without a network; may be repeated.
    """
    pairs: list[StereoPair] = []
    failures: list[str] = []
    for scene in scenes:
        with noted_failures(str(scene), failures):
            pairs.append(load_middlebury(scene))
    if not pairs:
        raise DeepDetectError("; ".join(failures))
    sources: dict[str, HeatmapDetector] = {}
    for name in label_settings or ():
        sources[f"labels {name}"] = LabelDetector(find_label_settings(name))
    for name in weights or (() if label_settings else PRETRAINED):
        sources[f"weights {name}"] = DeepDetect(name)
    rows = score_stereo_matches(sources, pairs, quiet=False)
    table = Table("stereo", "", STEREO_COLUMNS, rows)
    return cli.Result(rows, table.to_markdown(), failures, len(scenes), "scenes")


@cli.command()
def compare_clouds(
    model: Annotated[Path, Parameter(help="Folder that `deepdetect reconstruct` wrote.")],
    /,
    *clouds: Annotated[Path, Parameter(help="PLY files in the frame of the model.", required=True)],
) -> cli.Result:
    """Compare the dense points of a model with point clouds of other programs.

    Prints how much of the images each cloud covers, and how much its depths differ from those of
    model.ply. The clouds must be in the coordinate frame of the model, so run OpenMVS or COLMAP on
    the model's sparse/0.

        deepdetect dev compare-clouds model/ openmvs/scene_dense.ply colmap/fused.ply
    """
    rows = compare(model, [model / "model.ply", *clouds])
    table = Table("clouds", "", CLOUD_COLUMNS, rows, CLOUD_NOTE)
    return cli.Result(rows, f"{table.to_markdown()}\n\n{CLOUD_NOTE}")


ACCEPTANCE = cli.From(measure, "seeds every", more="")


@cli.command(ACCEPTANCE)
def acceptance(
    data: Annotated[Path, Parameter(help="Folder of the data sets.")],
    /,
    *,
    family: list[str] | None = None,
    engine: str | None = None,
    output: cli.Output = Path("acceptance"),
    **values: Any,
) -> cli.Result:
    """Run a matching engine on image pairs of many kinds, and count its right answers.

    Writes answers.jsonl, with a line for each answer, and acceptance.csv, with a line for each
    kind of pair. A second run only computes missing answers.

        deepdetect dev acceptance data -o today
        deepdetect dev acceptance data --family facades --every 5 --seeds 1 -o quick
        deepdetect dev acceptance data --engine my_engine:match -o mine

    Args:
        family: A family of pairs to match; may be repeated. [default: all]
        engine: A function MODULE:FUNCTION of two images and a seed that returns matches.
            [default: match_images]
        output: Folder for both files.
    """
    folder = cli.output_folder(output)
    for each in family or ():
        look_up("family", each, FAMILIES)
    chosen = guided() if engine is None else imported(engine)
    log, how = folder / "answers.jsonl", ACCEPTANCE.take(values)
    rows = measure(data, chosen, log, families=family or tuple(FAMILIES), quiet=False, **how)
    table = summary(rows)
    with atomic_path(folder / "acceptance.csv") as path:
        path.write_text(table.to_csv())
    return cli.Result(table.values(), f"{table.to_markdown()}\n\n{NOTE}")


OPTIONS = cli.From(BenchmarkOptions, "max_pairs max_images equal_density", more="ranker")


@cli.command(OPTIONS, NETWORK)
def benchmark(
    name: Annotated[str, Parameter(help=f"One of {', '.join(BENCHMARKS)}, or all.")],
    /,
    *,
    data: Path,
    output: cli.Output = Path("benchmark"),
    protocol: list[Literal["paper", "standard", "guided", "degraded"]] | None = None,
    method: list[str] | None = None,
    baselines: str | None = None,
    preset: Literal["default", "published"] = "default",
    cache: Path | None = None,
    geometry_weights: list[str] | None = None,
    **values: Any,
) -> cli.Result:
    """Evaluate detectors and write a report: report.md with figures, tables/*.csv, report.json.

    A second run computes only new results. Failures are listed at the end (exit code 1).

        deepdetect dev benchmark oxford --data data --max-pairs 1 --baselines sift -o quick
        deepdetect dev benchmark oxford --data data -o report --method xfeat.onnx
        deepdetect dev benchmark sfm --data data/fountain -o report

    Args:
        data: Folder of the data sets.
        output: Folder for the report.
        protocol: Any of paper, standard, guided, degraded; may be repeated.
            [default: all except degraded]
        method: A further method: NAME, FILE.onnx or MODULE:FUNCTION; may be repeated.
        baselines: Classical methods, separated by commas, or none. [default: all]
        preset: "published" gives the network BGR images, as the paper's code does; "default" gives
            it RGB images.
        cache: Folder for cached results.  [default: the folder cache in the output]
        geometry_weights: Weights (name or file) for stereo pairs; may be repeated. [default: dense]
    """
    output = cli.output_folder(output)
    if values.get("resolution") not in (None, "auto", "native"):
        raise OptionError("the protocols fix the resolution: leave out --resolution")
    names = list(BENCHMARKS) if name == "all" else [name]
    for each in names:
        look_up("benchmark", each, BENCHMARKS)
    given = OPTIONS.take(values)
    if baselines is not None:
        listed = [word.strip() for word in baselines.split(",")]
        given["classical"] = tuple(word for word in listed if word not in ("", "none"))
    given |= {"protocols": tuple(protocol)} if protocol else {}
    given |= {"geometry_weights": tuple(geometry_weights)} if geometry_weights else {}
    options = BenchmarkOptions(
        detector=DeepDetect(**values),
        others=tuple(find_feature(word) for word in method or ()),
        channels="bgr" if preset == "published" else "rgb",
        **given,
    )
    report = run_benchmarks(names, data, options, cache=cache or output / "cache", quiet=False)
    paths = report.save(output)
    tables = [f"{t.title}\n\n{t.to_markdown()}\n" for t in report.tables()]
    skipped = [f"skipped: {reason}" for reason in report.skipped if reason not in report.failures]
    return cli.Result(
        {**report.values(), "files": paths},
        "\n".join([*tables, *skipped, f"report: {paths[0]}"]),
        report.failures,
        what="parts",
    )
