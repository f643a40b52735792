"""The numbers that the paper prints, and how they are put beside ours.

"DeepDetect: Learning All-in-One Dense Keypoints", Tareen, Tareen, Fan and Yuan, arXiv:2510.17422:
those of its Tables I, II and III, of the captions of Figures 2, 6 and 8, and of its abstract; and
what the authors' public notebooks print besides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..report import Cell, Table

DEEPDETECT = "DeepDetect, threshold 0.5"
MAX_DIFFERENCE = 0.15
"""Relative difference from the paper's number beyond which a table remarks on it."""

DENSITY: dict[str, float] = {
    "SIFT": 0.0090,
    "SIFT, low settings": 0.1993,
    "ORB": 0.0009,
    "ORB, low settings": 0.1256,
    "BRISK": 0.0127,
    "BRISK, low settings": 0.0800,
    "FAST": 0.0270,
    "FAST, low settings": 0.3664,
    "AGAST": 0.0280,
    "AGAST, low settings": 0.3550,
    "Harris": 0.0246,
    "Harris, low settings": 0.2988,
    "Shi-Tomasi": 0.0052,
    "Shi-Tomasi, low settings": 0.0326,
    "DeepDetect, threshold 0.9": 0.4170,
    "DeepDetect, threshold 0.8": 0.4493,
    "DeepDetect, threshold 0.7": 0.4733,
    DEEPDETECT: 0.5143,
}
"""Table I: mean density on Oxford."""

FOREGROUND: dict[str, float] = {
    "SIFT": 0.7606,
    "SIFT, low settings": 0.3559,
    "ORB": 0.8508,
    "ORB, low settings": 0.6797,
    "BRISK": 0.7909,
    "BRISK, low settings": 0.5716,
    "FAST": 0.7442,
    "FAST, low settings": 0.5387,
    "AGAST": 0.7363,
    "AGAST, low settings": 0.5669,
    "Harris": 0.8262,
    "Harris, low settings": 0.7389,
    "Shi-Tomasi": 0.8026,
    "Shi-Tomasi, low settings": 0.6180,
    "DeepDetect, threshold 0.9": 0.7114,
    "DeepDetect, threshold 0.8": 0.7113,
    "DeepDetect, threshold 0.7": 0.7109,
    DEEPDETECT: 0.7093,
}
"""Table I: foreground-to-keypoint ratio on 18 photographs of the authors' own."""


def _columns(columns: Sequence[str], rows: Mapping[str, Sequence[float]]) -> dict[str, Paper]:
    """Turn rows of a printed table into columns by title."""
    return {title: {name: row[k] for name, row in rows.items()} for k, title in enumerate(columns)}


Paper = Mapping[str, float]
"""Numbers by column, of one row."""

MATCHES: dict[str, Paper] = _columns(
    (
        *("SIFT, low settings", "ORB, low settings", "BRISK, low settings", "FAST, low settings"),
        *("AGAST, low settings", "Harris, low settings", "Shi-Tomasi, low settings", DEEPDETECT),
    ),
    {
        "graf 1-6": (20, 5, 6, 13, 5, 54, 6, 102),
        "boat 1-2": (6517, 3749, 3836, 1703, 16238, 33385, 2164, 47447),
        "wall 1-6": (66, 13, 14, 2156, 2357, 4270, 175, 4756),
        "bikes 1-6": (268, 577, 358, 18112, 15458, 4652, 449, 16581),
        "leuven 1-6": (7822, 3582, 3163, 55427, 53972, 24296, 4159, 59003),
        "trees 1-6": (134, 234, 181, 12078, 12185, 3834, 178, 9368),
        "ubc 1-6": (790, 977, 464, 13024, 11327, 28655, 257, 40204),
    },
)
"""Table II: correct matches."""

SIFT_AND_OURS = ("SIFT", "SIFT, low settings", DEEPDETECT)

FIGURE_6: dict[str, Paper] = _columns(
    SIFT_AND_OURS,
    {
        "bikes 1-6": (50, 268, 16581),
        "graf 1-3": (368, 1020, 2715),
        "boat 1-2": (2202, 6517, 47447),
        "leuven 1-6": (355, 7822, 59003),
        "dusty 1-2": (0, 45, 502),
        "wall 1-6": (55, 66, 4756),
        "ubc 1-6": (252, 790, 40204),
        "trees 1-6": (39, 134, 9368),
    },
)
"""Figure 6: correct matches."""

FIGURE_2: dict[str, tuple[int, int, int]] = {
    "top": (279, 23_990, 46_309),
    "bottom": (1_009, 75_465, 51_115),
}
"""Keypoints of `SIFT_AND_OURS` in the two scenes of Figure 2, which the paper does not name."""

OXFORD_REPEATABILITY: dict[str, Paper] = {
    DEEPDETECT: {
        **{"mean": 0.9582, "graf": 0.89, "wall": 0.98, "bark": 0.91, "boat": 0.99},
        **{"leuven": 0.99, "bikes": 0.94, "trees": 0.95, "ubc": 0.90},
    },
    "R2D2": {
        **{"graf": 0.47, "wall": 0.71, "bark": 0.47, "boat": 0.57},
        **{"leuven": 0.77, "bikes": 0.76, "trees": 0.60, "ubc": 0.68},
    },
    "QuadNet": {
        **{"graf": 0.25, "wall": 0.46, "bark": 0.16, "boat": 0.29},
        **{"leuven": 0.77, "bikes": 0.57, "trees": 0.50, "ubc": 0.68},
    },
}
"""Table III, and the mean of Figure 1, which is above what clipping each pair at 1 leaves."""

HPATCHES_REPEATABILITY: dict[str, Paper] = {
    DEEPDETECT: {"illumination": 0.896, "viewpoint": 0.901},
    "SuperPoint": {"illumination": 0.652, "viewpoint": 0.503},
    "MagicPoint": {"illumination": 0.575, "viewpoint": 0.322},
}
"""Table III, on all 57 and 59 scenes."""

MAX_MATCHES = 338_118
"""Abstract: the most correct matches of one pair, on HPatches."""

FIGURE_8: dict[str, Mapping[str, int]] = {
    "SIFT": {"cones": 550, "dolls": 3788, "moebius": 2527, "rocks": 5230, "cloth": 5270},
    "SIFT, low settings": {
        **{"cones": 14_128, "dolls": 39_557, "moebius": 47_016},
        **{"rocks": 80_529, "cloth": 67_973},
    },
    "DeepDetect": {
        **{"cones": 49_979, "dolls": 540_780, "moebius": 363_703},
        **{"rocks": 709_425, "cloth": 842_045},
    },
}
"""Matches that are left after the essential matrix ("voxels"), by scene."""

FIGURE_8_CAUSES: dict[str, str] = {}

MATCHES_CAUSES: dict[str, str] = {}

NOTEBOOK_MATCHES: dict[str, dict[str, tuple[int, int]]] = {
    "DeepDetect": {"wall 1-6": (4_770, 479_562)},
    "SIFT, low settings": {"wall 1-6": (52, 163_510)},
}
"""Correct matches, and all, that the authors' notebooks print by Table II's protocol."""

NOTEBOOK_KEYPOINTS: dict[str, tuple[int, int]] = {
    "DeepDetect": (605_433, 477_060),
    "SIFT, low settings": (184_084, 118_628),
}
"""The keypoints of both images of wall 1-6 that they print."""


def paper_title(title: str) -> str:
    """Return the title of the row with the paper's numbers."""
    return f"{title}, in the paper"


def with_paper_rows(
    table: Table, paper: Mapping[str, Paper], causes: Mapping[str, str] | None = None
) -> Table:
    """Put the paper's numbers in a row below each of ours; rows of the paper only come last.

    Args:
        table: whose first column has the titles.
        paper: numbers by title of the row and by title of the column.
        causes: what is known of the cause of a difference, by title of the row.
    """
    titles = [column.title for column in table.columns]
    differences: dict[str, list[str]] = {}
    rows: list[tuple[Cell, ...]] = []

    def append(title: str, ours: Sequence[Cell]) -> None:
        numbers = [paper[title].get(name) for name in titles[1:]]
        if any(number is not None for number in numbers):
            rows.append((paper_title(title), *numbers))
        for column, cell, number in zip(table.columns[1:], ours, numbers, strict=True):
            if number is not None and _differs(cell, number):
                text = f"{column.title} {column.show(cell)} ({column.show(number)})"
                differences.setdefault(title, []).append(text)

    for row in table.rows:
        rows.append(row)
        if row[0] in paper:
            append(str(row[0]), row[1:])
    there = {row[0] for row in table.rows}
    for title in paper:
        if title not in there:
            append(title, (None,) * (len(titles) - 1))
    note = f"{table.note} {_remark(differences, causes or {})}".strip()
    return replace(table, rows=tuple(rows), note=note)


def with_paper_column(
    table: Table,
    title: str,
    paper: Mapping[str, float],
    causes: Mapping[str, str] | None = None,
) -> Table:
    """Put the paper's numbers in a column beside one of ours.

    Args:
        table: whose first column has the titles.
        title: of our column.
        paper: numbers by title of the row.
        causes: what is known of the cause of a difference, by title of the row.
    """
    k = [column.title for column in table.columns].index(title)
    column = table.columns[k]
    differences: dict[str, list[str]] = {}
    rows: list[tuple[Cell, ...]] = []
    for row in table.rows:
        number = paper.get(str(row[0]))
        rows.append((*row[: k + 1], number, *row[k + 1 :]))
        if number is not None and _differs(row[k], number):
            text = f"{column.show(row[k])} ({column.show(number)})"
            differences.setdefault(str(row[0]), []).append(text)
    beside = replace(column, title=paper_title(title))
    columns = (*table.columns[: k + 1], beside, *table.columns[k + 1 :])
    note = f"{table.note} {_remark(differences, causes or {})}".strip()
    return replace(table, columns=columns, rows=tuple(rows), note=note)


def _differs(ours: Cell, paper: float) -> bool:
    if not isinstance(ours, (int, float)) or ours == paper:
        return False
    return not abs(ours - paper) <= MAX_DIFFERENCE * abs(paper)


def _remark(differences: Mapping[str, Sequence[str]], causes: Mapping[str, str]) -> str:
    """Say which numbers are far from the paper's, and why where that is known."""
    if not differences:
        return ""
    parts = []
    for title, texts in differences.items():
        cause = causes.get(title, causes.get("", "cause unknown"))
        parts.append(f"{title}: {', '.join(texts)}; {cause}")
    return (
        f"More than {MAX_DIFFERENCE:.0%} from the paper's number (in brackets): {'. '.join(parts)}."
    )
