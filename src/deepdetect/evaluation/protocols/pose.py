"""Relative poses from matches, in images with known cameras."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from ...datasets.posed_images import PosedPair, PosedScene
from ..cache import Arrays, matrix_digest
from ..charts import line_chart
from ..context import BenchmarkContext
from ..metrics.pose import (
    EPIPOLAR_THRESHOLD_PX,
    POSE_THRESHOLDS_DEG,
    epipolar_inlier_ratio,
    pose_auc,
    rotation_error,
    translation_error,
)
from ..options import BenchmarkOptions
from ..report import Cell, Column, Figure, Table
from ..tasks import Part, SectionPlan, Shown, Task
from .pose_methods import (
    BUDGET,
    CONFIDENCE,
    RATIO,
    SIFT,
    STRAIGHT_AHEAD,
    THRESHOLD_PX,
    FoundMatches,
    PoseMethod,
    estimate_pose,
    pose_methods,
    straight_ahead,
)

GOOD_DEG = 5.0
"""Under which a pose counts as right where methods are compared pair by pair."""

CURVE_DEG = tuple(0.5 * step for step in range(41))
"""Errors at which the figure is drawn."""

GUIDES = ("homography", "fundamental", "none")

TEXT = (
    "Two images are matched, and the relative pose of their cameras is estimated from the matches "
    f"alone, the same way for all methods: OpenCV's MAGSAC at {THRESHOLD_PX:g} px with the true "
    f"intrinsics (confidence {CONFIDENCE:g}), then the one of four poses with most points in front "
    "of both cameras. The error of a pair is the larger of two angles: of the rotation, and "
    "between the directions of the translation; its length cannot be known. DeepDetect: "
    "`match_images` with its defaults (guided), and by descriptors alone (patchmatch, mutual "
    f"nearest neighbours). SIFT, ORB and further methods: the best {BUDGET:,} keypoints, exact "
    f"mutual nearest neighbours, ratio {RATIO:g} (none for learned descriptors).",
    f'"{STRAIGHT_AHEAD}" is a control that sees no image: no rotation, and the second camera in '
    "front of the first. In a clip from a moving car that is a strong guess, above all at short "
    "frame distances: a method is worth what it is better than this.",
    "The thresholds by which guided matching chooses between plane and depth were chosen on "
    "images of Strecha's fountain and of a KITTI clip. On these two the figures are no test of "
    "that choice. The true poses have errors of their own: KITTI's come from GPS and an inertial "
    "sensor, and where these gave nothing, poses are interpolated.",
)


@dataclass(frozen=True)
class PoseResult:
    """What one method gives on one pair.

    Attributes:
        rotation_deg, translation_deg: errors; infinite where no pose was found.
        matches: their number; None for the control, and so are all that follow.
        agreeing: fraction of the matches within `EPIPOLAR_THRESHOLD_PX` of the true pose.
        seconds: from the images to the matches.
        guided_by: as of `FoundMatches`.
    """

    rotation_deg: float
    translation_deg: float
    matches: int | None = None
    agreeing: float | None = None
    seconds: float | None = None
    guided_by: str | None = None

    @property
    def error_deg(self) -> float:
        """The larger of both errors."""
        return max(self.rotation_deg, self.translation_deg)


Key = tuple[str, int, str]
"""Scene, number of its pair, title of the method."""

Results = Mapping[Key, PoseResult]


def pose_section(
    context: BenchmarkContext, options: BenchmarkOptions, scenes: Sequence[PosedScene]
) -> SectionPlan:
    """Estimate the poses of all pairs by all methods."""
    methods = pose_methods(context, options)
    tasks = {
        (scene.name, number, method.title): Task(
            f"pose of {pair.name} by {method.title}", partial(measure_pair, context, method, pair)
        )
        for scene in scenes
        for number, pair in enumerate(scene.pairs)
        for method in methods
    }
    titles = [method.title for method in methods]

    def summarize(found: Results) -> Shown:
        return [
            pose_table(scenes, titles, found),
            *(
                distance_table(scene, titles, found)
                for scene in scenes
                if scene.pairs[0].frame_distance is not None
            ),
            pair_table(scenes, titles, found),
            *(error_figure(scene, titles, found) for scene in scenes),
        ]

    return SectionPlan("Relative poses", TEXT, [Part(tasks, summarize)])


def measure_pair(context: BenchmarkContext, method: PoseMethod, pair: PosedPair) -> PoseResult:
    """Measure a method on a pair, or read the result from the cache."""
    match = method.match
    if match is None:
        rotation, translation = straight_ahead()
        return PoseResult(
            rotation_error(rotation, pair.rotation),
            translation_error(translation, pair.translation),
        )

    def make() -> Arrays:
        found = match(pair)
        errors = _errors(found, pair)
        agreeing = epipolar_inlier_ratio(found.points0, found.points1, pair.fundamental)
        return {
            "numbers": np.array([*errors, len(found.points0), agreeing, found.seconds]),
            "guided_by": np.array(found.guided_by or ""),
        }

    matrices = (
        *(image.intrinsics for image in (pair.first, pair.second)),
        np.column_stack([pair.rotation, pair.translation]),
    )
    key = {
        **method.key(pair),
        "truth": [matrix_digest(matrix) for matrix in matrices],
        "estimate": [THRESHOLD_PX, CONFIDENCE, EPIPOLAR_THRESHOLD_PX],
    }
    kept = context.cache.get("pose", key, make)
    rotation_deg, translation_deg, matches, agreeing, seconds = kept["numbers"].tolist()
    guided_by = str(kept["guided_by"]) or None
    return PoseResult(rotation_deg, translation_deg, int(matches), agreeing, seconds, guided_by)


def _errors(found: FoundMatches, pair: PosedPair) -> tuple[float, float]:
    intrinsics = pair.first.intrinsics, pair.second.intrinsics
    pose = estimate_pose(found.points0, found.points1, *intrinsics)
    if pose is None:
        return float("inf"), float("inf")
    return rotation_error(pose[0], pair.rotation), translation_error(pose[1], pair.translation)


COLUMNS = (
    Column("pairs", ",d"),
    Column("failed", ",d"),
    *(Column(f"AUC at {threshold:g}°", ".3f") for threshold in POSE_THRESHOLDS_DEG),
    Column("median error, °", ".2f"),
    Column("matches", ",.0f"),
    Column(f"agreeing within {EPIPOLAR_THRESHOLD_PX:g} px", ".1%"),
)

NOTE = (
    "Failed: pairs without a pose; their error counts as infinite. AUC: area under the curve of "
    "the pairs' errors up to a threshold, as SuperGlue and glue-factory compute it, but an "
    "opposite translation is wrong here. Matches: median. Agreeing: fraction of the matches whose "
    f"Sampson distance from the true epipolar geometry is under {EPIPOLAR_THRESHOLD_PX:g} px, mean "
    "over the pairs, where no matches count as 0; a match that slid along its epipolar line "
    "agrees, too."
)


def _summary(results: Sequence[PoseResult]) -> tuple[Cell, ...]:
    """Return the cells of `COLUMNS`."""
    errors = [result.error_deg for result in results]
    matches = [result.matches for result in results if result.matches is not None]
    agreeing = [result.agreeing for result in results if result.agreeing is not None]
    return (
        len(results),
        int(np.isinf(errors).sum()),
        *(pose_auc(errors, threshold) if errors else None for threshold in POSE_THRESHOLDS_DEG),
        float(np.median(errors)) if errors else None,
        float(np.median(matches)) if matches else None,
        float(np.mean(agreeing)) if agreeing else None,
    )


def pose_table(scenes: Sequence[PosedScene], titles: Sequence[str], found: Results) -> Table:
    """Tabulate each method on each scene, losses to SIFT beside wins."""
    columns = (
        Column("scene"),
        Column("method"),
        *COLUMNS,
        *(
            Column(f"guided by {guide}" if guide != "none" else "unguided", ",d")
            for guide in GUIDES
        ),
        Column("worse than SIFT", ",d"),
        Column("better than SIFT", ",d"),
        Column("seconds", ".2f"),
    )
    rows = []
    for scene in scenes:
        numbers = range(len(scene.pairs))
        for title in titles:
            mine = {n: found[key] for n in numbers if (key := (scene.name, n, title)) in found}
            sift = {n: found[key] for n in mine if (key := (scene.name, n, SIFT)) in found}
            guides = Counter(result.guided_by for result in mine.values())
            seconds = [one.seconds for one in mine.values() if one.seconds is not None]
            rows.append(
                (
                    scene.name,
                    title,
                    *_summary(list(mine.values())),
                    *(guides[guide] if set(guides) - {None} else None for guide in GUIDES),
                    *_duels(mine, sift if title != SIFT else {}),
                    float(np.median(seconds)) if seconds else None,
                )
            )
    note = (
        f"{NOTE} Guided by: in how many pairs which geometry guided. Worse than SIFT: pairs with "
        f"an error of {GOOD_DEG:g}° or more where SIFT's is under it; better: the other way round. "
        "Seconds: median, from the images to the matches; they may be those of an earlier run, "
        "from the cache, on whatever else the machine did then."
    )
    return Table("pose", "Relative poses", columns, tuple(rows), note)


def _duels(
    mine: Mapping[int, PoseResult], sift: Mapping[int, PoseResult]
) -> tuple[int | None, int | None]:
    """Count the pairs in which only SIFT is right, and those in which only the other is."""
    if not sift:
        return None, None
    right = [(mine[n].error_deg < GOOD_DEG, sift[n].error_deg < GOOD_DEG) for n in sift]
    return right.count((False, True)), right.count((True, False))


def distance_table(scene: PosedScene, titles: Sequence[str], found: Results) -> Table:
    """Tabulate each method at each frame distance of a sequence."""
    distances = sorted({pair.frame_distance or 0 for pair in scene.pairs})
    rows = [
        (
            distance,
            title,
            *_summary(
                [
                    found[key]
                    for number, pair in enumerate(scene.pairs)
                    if pair.frame_distance == distance
                    and (key := (scene.name, number, title)) in found
                ]
            ),
        )
        for distance in distances
        for title in titles
    ]
    columns = (Column("frame distance", "d"), Column("method"), *COLUMNS)
    title = f"Relative poses in {scene.name}, by frame distance"
    return Table(f"pose_{_file_name(scene)}_distances", title, columns, tuple(rows), NOTE)


def pair_table(scenes: Sequence[PosedScene], titles: Sequence[str], found: Results) -> Table:
    """Tabulate each method on each pair."""
    columns = (
        *(Column("pair"), Column("method"), Column("frame distance", "d")),
        *(Column(f"{kind} error, °", ".3f") for kind in ("rotation", "translation", "pose")),
        Column("matches", ",d"),
        Column(f"agreeing within {EPIPOLAR_THRESHOLD_PX:g} px", ".1%"),
        *(Column("guided by"), Column("seconds", ".2f")),
    )
    rows = []
    for scene in scenes:
        for number, pair in enumerate(scene.pairs):
            for title in titles:
                one = found.get((scene.name, number, title))
                if one is not None:
                    errors = one.rotation_deg, one.translation_deg, one.error_deg
                    rest = one.matches, one.agreeing, one.guided_by, one.seconds
                    rows.append((pair.name, title, pair.frame_distance, *errors, *rest))
    return Table(
        "pose_pairs", "Relative poses, all pairs", columns, tuple(rows), NOTE, in_text=False
    )


def error_figure(scene: PosedScene, titles: Sequence[str], found: Results) -> Figure:
    """Draw the fraction of the pairs under each error."""
    lines = {}
    for title in titles:
        keys = [(scene.name, number, title) for number in range(len(scene.pairs))]
        errors = np.array([found[key].error_deg for key in keys if key in found])
        if len(errors):
            lines[title] = CURVE_DEG, [float((errors <= limit).mean()) for limit in CURVE_DEG]
    png = line_chart(lines, "pose error up to, °", "fraction of the pairs")
    title = f"Relative poses in {scene.name}: fraction of the pairs up to each error"
    return Figure(f"pose_{_file_name(scene)}", title, png)


def _file_name(scene: PosedScene) -> str:
    return re.sub(r"\W+", "_", scene.name)
