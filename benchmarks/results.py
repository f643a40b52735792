"""Compute the result tables of README.md and the pages, and insert them there.

    python benchmarks/results.py DATA [--published FOLDER] [--only NAME ...] [--work build/results]
    python benchmarks/results.py [--check]

The first command (`make results DATA=... ONLY=...`) runs the benchmarks, each with a cache, so that
an interrupted run can continue. It writes `docs/results/NAME.csv`, and the command, commit,
versions and machine of each result to `docs/results/index.json`. Some results need the authors'
weights.

The second command fills the blocks of the pages between `<!-- results:NAME -->` and
`<!-- /results -->` from these files. `<!-- results:NAME first|second -->` chooses columns. A single
cell in a sentence stands between `<!-- result:NAME|row|column -->` and `<!-- /result -->`. With
--check, the command only reports whether the blocks agree with the files.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import shlex
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from deepdetect_lab.evaluation.provenance import provenance

ROOT = Path(__file__).parents[1]
RESULTS_FOLDER = ROOT / "docs" / "results"
BLOCK = re.compile(r"(<!-- results:([\w-]+)(?: ([^\n]*?))? -->\n).*?(<!-- /results -->)", re.DOTALL)

CELL = re.compile(r"(<!-- result:(.*?) -->)[^<]*(<!-- /result -->)")

BENCHMARK = "-m deepdetect dev benchmark {} --data {{data}} -o {{output}}"
PEERS = ("xfeat_2048_600x800", "edgepoint2_t32", "edgepoint2_e64")
METHODS = [f" --method {{published}}/peers/{name}.onnx" for name in PEERS]
XFEAT, _, E64 = METHODS
PAGES = [
    page
    for folder in (".", "docs", "src/deepdetect/detector/weights")
    for page in sorted((ROOT / folder).glob("*.md"))
]
"""Pages whose blocks are filled."""
STAGES = {
    **{
        name: BENCHMARK.format(words)
        for name, words in {
            "oxford-paper": "oxford --protocol paper",
            "oxford-standard": "oxford --protocol standard" + XFEAT,
            "oxford-guided": "oxford --protocol guided",
            "hpatches": "hpatches --protocol paper",
            "foreground": "foreground" + XFEAT,
            "low-visibility": "low-visibility --protocol paper" + XFEAT,
            "oxford-espnet": "oxford --protocol paper --baselines none --weights espnet",
            "oxford-published": "oxford --protocol paper --baselines none --preset published "
            "--weights {published}/published_matching.onnx",
            "middlebury": "middlebury --geometry-weights dense "
            "--geometry-weights {published}/published_reconstruction.onnx",
            "pose": "pose --baselines sift,orb --max-pairs 45" + XFEAT + E64,
            "sfm": "sfm",
        }.items()
    },
    "label-prediction": "-m deepdetect dev evaluate {data}/label-samples/val --json --scale 0.5 "
    "--scale 2 --compare espnet --compare free "
    "--compare {published}/published_matching.onnx",
    "validation": "benchmarks/validation_photographs.py {data}/photos/val --weights default "
    "--weights espnet",
    "labels-stereo": "-m deepdetect dev evaluate-stereo {data}/middlebury/cones "
    "{data}/middlebury/teddy --label-settings paper --label-settings dense --weights default "
    "--weights dense",
    "disparity": "benchmarks/row_matching.py {data}/middlebury",
    "motorcycle": "benchmarks/motorcycle_matching.py",
    "costs": "benchmarks/costs.py {data}/fountain/0004.jpg {data}/fountain/0005.jpg",
    "times": "benchmarks/times.py {data} --cache {output}/cache" + "".join(METHODS),
    "published-pipeline": "benchmarks/published_pipeline.py {data}",
    "descriptors": "benchmarks/descriptors.py {data}" + "".join(METHODS),
    "fuzz": "-m fuzz",
    "mappers": "benchmarks/mappers.py",
    "scale": "benchmarks/scale.py {data}/photos --work {output}",
    "match-filter": "benchmarks/match_filter.py {data}",
    "exact-matches": "benchmarks/exact_matches.py {data}",
    "swap": "benchmarks/swap.py {data}",
    "modalities": f"benchmarks/modalities.py {{data}}/multimodal{XFEAT}{E64}",
    "made-scenes": "benchmarks/made_scenes.py {data} --scenes {output}/scenes",
}
"""Python's arguments for each stage, by name. Stages without a report print tables or JSON."""

TITLES: dict[str, str] = json.loads((RESULTS_FOLDER / "titles.json").read_text("utf-8"))
"""Shorter titles of rows, by their full titles."""

OWN = ", own size and angle"
"""Rows whose titles end with this text become a column."""

CLASSICAL = ("SIFT", "ORB", "BRISK", "FAST", "AGAST", "Harris", "Shi-Tomasi")


@dataclass(frozen=True)
class Result:
    """A table of docs/results.

    Attributes:
        stage: key of `STAGES`.
        table: key of the report's table, or the number of a printed table. A key that ends in *
            means the rows of all tables whose keys begin with the text before the *. The rest of
            a table's key becomes a cell of its rows.
        columns: maps a title in the result to the title in the table, the number format, and
            optionally the key of another table that has the column, and a suffix that names of
            rows have there. Empty: all columns, with four decimals.
        rows: only rows whose first or second cell begins with this text.
    """

    stage: str
    table: str
    columns: dict[str, tuple[str, ...]] = field(default_factory=dict)
    rows: str = ""


LIGHTS, MASKS = ("normal", "low"), ("loss", "iou", "calibration_error", "density")
SCENES = ("bark", "bikes", "boat", "graf", "leuven", "trees", "ubc", "wall")
PAIRS = ("graf 1-6", "wall 1-6", "bikes 1-6", "leuven 1-6", "trees 1-6", "ubc 1-6", "boat 1-2")
GUIDED: dict[str, tuple[str, ...]] = {
    "unguided, correct": ("descriptors alone: correct", ".0f"),
    "precision": ("descriptors alone: precision", ".3f"),
    "guided, correct": ("guided: correct", ".0f"),
    "guided, precision": ("guided: precision", ".3f"),
    "of the ceiling": ("guided: of the matchable", ".3f"),
    "lowest of three seeds": ("lowest", ".3f"),
    "one to one": ("guided: unique", ".0f"),
    "corner error, px": ("guided: corner error, px", ".2f"),
}
RESULTS = {
    "density": Result(
        "oxford-paper",
        "oxford_density",
        {
            "mean": ("mean", ".4f"),
            "without trees": ("mean without trees", ".4f"),
            "in the paper": ("mean without trees, in the paper", ".4f"),
            **{scene: (scene, ".3f") for scene in SCENES},
        },
    ),
    "repeatability-paper": Result(
        "oxford-paper",
        "oxford_repeatability",
        {"mean": ("mean", ".4f"), **{scene: (scene, ".3f") for scene in SCENES}},
    ),
    "correct-matches": Result(
        "oxford-paper", "oxford_matches", {pair: (pair, ".0f") for pair in PAIRS}
    ),
    "correct-matches-figure-6": Result(
        "oxford-paper", "oxford_figure6", {pair: (pair, ".0f") for pair in ("graf 1-3", *PAIRS[1:])}
    ),
    **{
        f"{name}-weights": Result(
            f"oxford-{name}",
            "oxford_density",
            {
                "density": ("mean", ".4f"),
                "repeatability": ("mean", ".4f", "oxford_repeatability"),
                **{pair: (pair, ".0f", "oxford_matches") for pair in PAIRS},
            },
            rows="DeepDetect, threshold 0.5",
        )
        for name in ("espnet", "published")
    },
    "label-prediction": Result("label-prediction", "0"),
    "validation": Result("validation", "0"),
    "repeatability-one-to-one": Result(
        "oxford-standard",
        "oxford_refined_repeatability_1px",
        {
            **{budget.replace(",", ""): (budget, ".3f") for budget in ("512", "1,024", "2,048")},
            "chance at 2048": ("2,048: chance", ".3f"),
            "8192": ("8,192", ".3f"),
            "all": ("all", ".3f"),
            "chance": ("all: chance", ".3f"),
            "above chance": ("all: chance-corrected", ".3f"),
            "keypoints of all": ("keypoints of all", ".0f"),
        },
    ),
    "homographies-2048": Result(
        "oxford-standard",
        "oxford_refined_homography",
        {
            **{f"≤ {px} px": (f"accuracy at {px} px", ".3f") for px in (1, 3, 5)},
            **{f"AUC {px} px": (f"AUC at {px} px", ".3f") for px in (1, 3, 5)},
        },
    ),
    "matching-2048": Result(
        "oxford-standard",
        "oxford_refined_matching",
        {
            "matches": ("matches", ".0f"),
            "correct, 1 px": ("correct at 1 px", ".0f"),
            "correct, 3 px": ("correct at 3 px", ".0f"),
            "precision, 3 px": ("precision at 3 px", ".3f"),
            "score, 3 px": ("matching score at 3 px", ".3f"),
        },
    ),
    "guided": Result("oxford-guided", "oxford_guided_refined", GUIDED, rows="DeepDetect"),
    "guided-baselines": Result(
        "oxford-guided", "oxford_guided_refined", {"method": ("method", ""), **GUIDED}
    ),
    "repeatability-hpatches": Result("hpatches", "hpatches_table3"),
    "points": Result(
        "oxford-standard",
        "oxford_refined_repeatability_1px",
        {
            "@1 512": ("512", ".3f"),
            "@1 2048": ("2,048", ".3f"),
            "@1 8192": ("8,192", ".3f"),
            "@3 2048": ("2,048", ".3f", "oxford_refined_repeatability_3px"),
            "@3 8192": ("8,192", ".3f", "oxford_refined_repeatability_3px"),
            "correct": ("correct at 1 px", ".0f", "oxford_refined_matching"),
            "within 1 px": ("accuracy at 1 px", ".3f", "oxford_refined_homography"),
            OWN[2:]: ("accuracy at 1 px", ".3f", "oxford_refined_homography", OWN),
        },
    ),
    "points-by-change": Result("oxford-standard", "oxford_refined_kinds"),
    "middlebury": Result(
        "middlebury",
        "middlebury_*",
        {
            "points": ("points", ".0f"),
            **{f"within {t} px": (f"1 - bad-{t}", ".3f") for t in ("0.5", "1", "2", "4")},
            "mean error (EPE), px": ("EPE, px", ".2f"),
            "completeness": ("completeness at 1 px", ".3f"),
            "F-score": ("F-score", ".3f"),
            "half-occluded: points": ("half-occluded, with a point", ".0f"),
            "half-occluded: within 1 px": ("of these within 1 px", ".3f"),
            "s": ("seconds", ".2f"),
            "MB": ("all, MB", ".0f"),
        },
    ),
    "poses": Result(
        "pose",
        "pose",
        {
            "method": ("method", ""),
            **{f"AUC {limit}°": (f"AUC at {limit}°", ".3f") for limit in (5, 10, 20)},
            "median error, °": ("median error, °", ".2f"),
            "matches": ("matches", ".0f"),
            "worse than SIFT": ("worse than SIFT", ""),
            "better than SIFT": ("better than SIFT", ""),
        },
    ),
    "cameras": Result(
        "sfm",
        "sfm",
        {
            "keypoints": ("keypoints", ""),
            "intrinsics": ("intrinsics", ""),
            "registered": ("registered", ""),
            "AUC 5°": ("AUC at 5°", ".3f"),
            "centres, m": ("centres, unit of the truth", ".4f"),
            "from the first row's, m": ("from the first row's, unit of the truth", ".4f"),
            "rotations, °": ("rotations, °", ".3f"),
            "sparse points": ("sparse points", ".0f"),
            "track length": ("track length", ".2f"),
            "their error, px": ("reprojection error, px", ".2f"),
        },
    ),
    "cameras-cost": Result(
        "sfm",
        "sfm_cost",
        {
            "keypoints": ("keypoints", ""),
            "keypoints and matches, CPU s": ("keypoints and matches, CPU s", ".1f"),
            "mapping, intrinsics estimated, CPU s": ("mapping, estimated intrinsics, CPU s", ".1f"),
            "MB": ("memory, MB", ".0f"),
        },
    ),
    "dense-points": Result(
        "sfm",
        "sfm_dense",
        {
            "depth maps": ("depth maps", ""),
            "points": ("points", ".0f"),
            "own map": ("share, own map", ".3f"),
            "all maps": ("share, all maps", ".3f"),
            "error, px": ("median error, px", ".3f"),
            "halves differ by": ("halves: median difference", ".5f"),
            "by over 1 %": ("halves: share apart", ".4f"),
            "CPU s an image": ("CPU s an image", ".1f"),
        },
    ),
    "labels-stereo": Result("labels-stereo", "0"),
    "disparity": Result("disparity", "0"),
    "motorcycle": Result("motorcycle", "0"),
    "costs": Result("costs", "0"),
    "times": Result("times", "0"),
    "published-pipeline": Result("published-pipeline", "0"),
    "descriptors": Result("descriptors", "0"),
    "fuzz": Result("fuzz", "0"),
    "mappers": Result("mappers", "0"),
    "scale": Result("scale", "0"),
    "match-filter": Result("match-filter", "0"),
    "exact-matches": Result("exact-matches", "0"),
    "swap": Result("swap", "0"),
    "modalities": Result("modalities", "0"),
    "made-scenes": Result("made-scenes", "0"),
    "foreground": Result(
        "foreground",
        "foreground",
        {
            "on the foreground": ("fraction on the foreground", ".3f"),
            "in the paper": ("fraction on the foreground, in the paper", ".3f"),
            "over random": ("over that of random points", ".2f"),
            "density": ("keypoints per pixel", ".3f"),
        },
    ),
    "low-visibility-density": Result(
        "low-visibility", "low_visibility_density", {s: (s, ".3f") for s in ("dusty", "smoky")}
    ),
    "low-visibility-matches": Result(
        "low-visibility",
        "low_visibility_matches",
        {
            "dusty": ("dusty 1-2", ".0f"),
            "dusty, precision": ("dusty 1-2, precision", ".1%"),
            "smoky": ("smoky 1-2", ".0f"),
            "smoky, precision": ("smoky 1-2, precision", ".1%"),
        },
    ),
}


def main() -> None:
    """Run the chosen benchmarks, then fill the blocks."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, help="folder of the data sets")
    parser.add_argument("--published", type=Path, help="folder of others' weights, as ONNX files")
    parser.add_argument("--only", nargs="+", choices=sorted(RESULTS), default=sorted(RESULTS))
    parser.add_argument("--work", type=Path, default=ROOT / "build" / "results")
    parser.add_argument("--check", action="store_true", help="compare the blocks, fill none")
    arguments = parser.parse_args()
    if arguments.data is not None:
        for stage in dict.fromkeys(RESULTS[name].stage for name in arguments.only):
            run_stage(stage, arguments.data, arguments.published, arguments.work)
        for name in arguments.only:
            write_result(name, arguments.work)
        if {"times", "descriptors"} & set(arguments.only):
            subprocess.run([sys.executable, ROOT / "docs" / "figures" / "times.py"], check=True)
    stale = fill_blocks(write=not arguments.check)
    if arguments.check and stale:
        raise SystemExit(f"run python benchmarks/results.py: {', '.join(stale)} is out of date")


def run_stage(stage: str, data: Path, published: Path | None, work: Path) -> None:
    """Run a stage and write its report; benchmarks continue from their cache."""
    folder = work / stage
    if published is None and "{published}" in STAGES[stage]:
        raise SystemExit(f"the stage {stage} needs the authors' weights: give --published")
    places = {"data": data, "output": folder, "published": published}
    words = [word.format(**places) for word in STAGES[stage].split()]
    print(shlex.join(words), flush=True)
    if "benchmark" in words:
        subprocess.run([sys.executable, *words], check=True)
        return
    folder.mkdir(parents=True, exist_ok=True)
    printed = folder / "printed.txt"  # is kept if parsing fails, because stages take hours
    with printed.open("w") as stdout:
        subprocess.run([sys.executable, *words], check=True, stdout=stdout)
    text = printed.read_text()
    found = [evaluated(text)] if "--json" in words else printed_tables(text)
    tables = {str(k): {"rows": rows} for k, rows in enumerate(found)}
    (folder / "report.json").write_text(json.dumps({"metadata": {}, "tables": tables}))


def evaluated(text: str) -> list[dict[str, Any]]:
    """Convert the output of `deepdetect dev evaluate --json` to rows, one for each weights."""
    report = json.loads(text)
    rows = []
    for of in (report, *report["compare"]):
        scores = {light: of[light] for light in LIGHTS}
        scores |= {f"{of['visibility']} x{of['scale']:g}": of for of in of["scales"]}
        values = {f"{n}, {name}": score[name] for n, score in scores.items() for name in MASKS}
        rows.append({"weights": Path(of["weights"]).stem, **values})
    return rows


def printed_tables(text: str) -> list[list[dict[str, str]]]:
    r"""Return the rows of the Markdown tables in a text.

    Example:
        >>> printed_tables("| a | b |\n|---|--:|\n| x\\|y | 1,024 |\n| y | – |\n")
        [[{'a': 'x|y', 'b': '1024'}, {'a': 'y', 'b': ''}]]
    """
    tables = []
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        head, _, *rows = (
            [cell.strip().replace("\\|", "|") for cell in re.split(r"(?<!\\)\|", line[1:-1])]
            for line in block.splitlines()
        )
        plain = [[re.sub(r"(?<=\d),(?=\d{3})|^–$", "", cell) for cell in row] for row in rows]
        tables.append([dict(zip(head, row, strict=True)) for row in plain])
    return tables


def write_result(name: str, work: Path) -> None:
    """Write a table of a report as docs/results/NAME.csv, and its provenance to index.json."""
    result = RESULTS[name]
    report = json.loads((work / result.stage / "report.json").read_text())
    tables = {key: table["rows"] for key, table in report["tables"].items()}
    start, several, _ = result.table.partition("*")
    keys = [key for key in tables if key.startswith(start)] if several else [result.table]
    first = next(iter(tables[keys[0]][0]))
    titles = list(tables[keys[0]][0])[1:]
    columns = result.columns or {TITLES.get(title, title): (title, "") for title in titles}
    by_name = {(key, row.get(first)): row for key in tables for row in tables[key]}
    lines = [[*(["scene"] if several else []), first, *columns]]
    for key in keys:
        for row in tables[key]:
            cells = [str(cell) for cell in list(row.values())[:2]]
            if cells[0].endswith(OWN) or not any(x.startswith(result.rows) for x in cells):
                continue
            lines.append([key.removeprefix(start)] if several else [])
            lines[-1].append(TITLES.get(row[first], row[first]))
            for title, style, *other in columns.values():
                named = (*other[:1], row[first] + "".join(other[1:]))
                cell = (by_name.get(named, {}) if other else row).get(title)
                style = style or (".4f" if isinstance(cell, float) else "")
                lines[-1].append("" if cell is None else format(TITLES.get(cell, cell), style))
    with (RESULTS_FOLDER / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(lines)
    index = json.loads((RESULTS_FOLDER / "index.json").read_text())
    places = {"data": "DATA", "output": "REPORT", "published": "PUBLISHED"}
    command = "python " + STAGES[result.stage].format(**places)
    made = provenance() | {"command": command.replace("python -m deepdetect", "deepdetect")}
    weights = report["metadata"].get("weights (SHA-256)")
    index["results"][name] = made | ({"weights": weights} if weights else {})
    index["results"] = dict(sorted(index["results"].items()))
    text = json.dumps(index, indent=1, ensure_ascii=False) + "\n"
    (RESULTS_FOLDER / "index.json").write_text(text, encoding="utf-8")


def read_result(name: str) -> list[list[str]]:
    """Read a table of docs/results, with its header first."""
    with (RESULTS_FOLDER / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


def fill_blocks(write: bool) -> list[str]:
    """Return the names of pages with outdated blocks, which are filled if `write`."""
    stale = []
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        filled = BLOCK.sub(lambda m: f"{m[1]}{block(m[2], m[3])}\n{m[4]}", text)
        filled = CELL.sub(lambda m: f"{m[1]}{shown(cell(m[2]))}{m[3]}", filled)
        if filled != text:
            stale.append(page.name)
            if write:
                page.write_text(filled, encoding="utf-8")
    return stale


def block(name: str, columns: str | None) -> str:
    """Return the Markdown table of a block."""
    composed = (RESULTS_FOLDER / f"{name}.json").exists()
    head, *rows = composed_table(name) if composed else read_result(name)
    wanted = head if columns is None else [head[0], *columns.split("|")]
    places = [head.index(title) for title in wanted]
    lines = [[shown(row[k]) for k in places] for row in rows]
    heads = [shown(title) if title else "" for title in wanted]
    rule = "|---|" + "---:|" * (len(places) - 1)
    first, *others = ("| " + " | ".join(line) + " |" for line in (heads, *lines))
    return "\n".join([first.replace("|  |", "| |"), rule, *others])


def shown(cell: str) -> str:
    """Format a cell for a page: commas between thousands, leading zeros, a dash if empty.

    Example:
        >>> shown("192540 (.971)"), shown("-0.000"), shown("")
        ('192,540 (0.971)', '0.000', '–')
    """
    apart = re.sub(r"(?<![\d.,x])\d{4,}(?![\d.x])", lambda m: f"{int(m[0]):,}", cell)
    apart = re.sub(r"(?<![\d.])(?=\.\d)", "0", re.sub(r"^-(?=0\.0+$)", "", apart))
    return apart.replace("|", "\\|") if cell else "–"


def composed_table(name: str) -> list[list[str]]:
    """Return the table of docs/results/NAME.json, where {result|row|column} is a cell of a result.

    A row is identified by its first cell or its first two. The row "best" is the classical detector
    with the highest number.
    """
    rows: list[list[str]] = json.loads((RESULTS_FOLDER / f"{name}.json").read_text("utf-8"))
    return [[re.sub(r"{(.*?)}", lambda m: cell(m[1]), text) for text in row] for row in rows]


def cell(place: str) -> str:
    """Return the cell of a result at a place such as result|row|column."""
    (name, _, row), column = place.rpartition("|")[0].partition("|"), place.rpartition("|")[2]
    head, *lines = read_result(name)
    k = head.index(column)
    if row == "best":
        known = [
            x
            for x in lines
            if x[0].startswith(CLASSICAL) and not re.search("paper|as it is|own", x[0])
        ]
        best = max(known, key=lambda line: float(line[k] or 0))
        return f"{best[k]} ({best[0]})"
    return next(x[k] or "–" for x in lines if row in (x[0], ", ".join(x[:2])))


if __name__ == "__main__":
    main()
