"""The paper's protocol: density, share on the foreground, repeatability and correct matches."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from deepdetect._shared.errors import ImageError
from deepdetect.features.keypoints import Keypoints
from deepdetect.geometry.transforms import transfer_errors
from deepdetect.io.image import load_image, luma
from deepdetect.io.masks import load_mask
from deepdetect.viz.draw import add_caption, draw_matches

from ...datasets.foreground import MaskedPhotograph, load_foreground
from ...datasets.planar import PlanarPair, PlanarScene
from ...labels.fusion import join_pictures
from ..baselines.method import LocalFeature
from ..metrics.repeatability import foreground_fraction, repeatability_paper
from ..options import BenchmarkOptions
from ..report import (
    Cell,
    Columns,
    Figure,
    Row,
    Rows,
    Section,
    Table,
    average,
    mean,
    mean_of,
    picture,
    tabulate,
    where,
)
from ..run import MatchSettings, Run
from .paper_numbers import DENSITY, FOREGROUND, NOT_IN_DENSITY, with_paper_column

OXFORD_PAIRS = (
    *(("graf", 6), ("wall", 6), ("bikes", 6), ("leuven", 6), ("trees", 6), ("ubc", 6)),
    ("boat", 2),
)
"""Image pairs of the paper's Table II: scene, and number of the image paired with image 1."""

CORRECT_PX = 1.0
"""A match is correct if its transfer error under the true homography is strictly below this."""

PAPER_MATCHING = MatchSettings(matcher="flann", ratio=0.99)

REPEATABILITY_NOTE = (
    "Repeatability: number of keypoints of the first image that the true homography maps to less "
    "than 1 px from any keypoint of the second, divided by the number of keypoints in the image "
    "that has fewer; at most 1. Detectors with more keypoints get higher values, even if the "
    "keypoints are random, as the baselines show."
)

MATCHES_NOTE = (
    "Descriptors are matched by FLANN (5 trees, 50 checks) with ratio 0.99, binary ones (ORB, "
    "BRISK) exactly by Hamming distance. Correct: matches with an error strictly under 1 px by the "
    "published homography. Detectors with more keypoints get more correct matches, even if the "
    "keypoints are random, as the baselines show."
)


def density_table(
    run: Run,
    features: Sequence[LocalFeature],
    scenes: Sequence[PlanarScene],
    key: str,
    with_paper: bool = False,
) -> Table:
    """Tabulate the keypoints per pixel: the mean over all images, and the mean of each scene.

    If `with_paper`, the paper's means, which leave out `NOT_IN_DENSITY`, are shown next to ours.
    """

    def measure(feature: LocalFeature, item: tuple[str, Path]) -> Row:
        scene, image = item
        return {"scene": scene, "density": run.keypoints(feature, image)[0].density}

    def without(own: Rows) -> Cell:
        return mean_of(row["density"] for row in own if row["scene"] != NOT_IN_DENSITY)

    images = {f"{s.name}/{path.name}": (s.name, path) for s in scenes for path in s.images}
    rows = run.rows("density of ", features, images, measure)
    title = f"mean without {NOT_IN_DENSITY}"
    columns: Columns = {
        "mean": average(".4f", "density"),
        **({title: (".4f", without)} if with_paper else {}),
        **{scene.name: average(".4f", "density", scene=scene.name) for scene in scenes},
    }
    note = "The mean is over all images. Several keypoints at the same pixel all count."
    if with_paper:
        note += f" The paper's means leave out {NOT_IN_DENSITY}."
    table = tabulate(key, "Keypoints per pixel", features, rows, columns, note)
    return with_paper_column(table, title, DENSITY) if with_paper else table


def repeatability_table(
    run: Run, features: Sequence[LocalFeature], scenes: Sequence[PlanarScene], key: str
) -> Table:
    """Tabulate the paper's repeatability at 1 px: the mean of each scene, and of all scenes."""

    def measure(feature: LocalFeature, pair: PlanarPair) -> Row:
        return {"scene": pair.scene, "repeatability": pair_repeatability(run, feature, pair)}

    def over_scenes(own: Rows) -> Cell:
        return mean_of(mean(where(own, scene=s.name), "repeatability") for s in scenes)

    pairs = {pair.name: pair for scene in scenes for pair in scene.pairs}
    rows = run.rows("repeatability of ", features, pairs, measure)
    columns: Columns = {
        "mean": (".4f", over_scenes),
        **{scene.name: average(".4f", "repeatability", scene=scene.name) for scene in scenes},
    }
    title = "Repeatability as in the paper"
    return tabulate(key, title, features, rows, columns, REPEATABILITY_NOTE)


def matches_table(
    run: Run,
    features: Sequence[LocalFeature],
    pairs: Sequence[PlanarPair],
    key: str,
    title: str = "Correct matches",
) -> Table:
    """Tabulate for each pair the number of matches with an error under 1 px, and their fraction."""

    def measure(feature: LocalFeature, pair: PlanarPair) -> Row:
        correct, matches = correct_matches(run, feature, pair)
        return {"correct": correct, "precision": correct / matches if matches else None}

    def value(own: Rows, item: str, name: str) -> Cell:
        return next((row[name] for row in where(own, item=item)), None)

    rows = run.rows("matches of ", features, {pair.name: pair for pair in pairs}, measure)
    columns: Columns = {
        f"{pair.name}{suffix}": (style, partial(value, item=pair.name, name=name))
        for pair in pairs
        for suffix, style, name in (("", ",d", "correct"), (", precision", ".2%", "precision"))
    }
    return tabulate(key, title, features, rows, columns, MATCHES_NOTE)


def foreground(run: Run, options: BenchmarkOptions) -> list[Section]:
    """Run the benchmark: the fraction of keypoints on the foreground, as in the paper's Table I."""
    images = load_foreground(run.folder("foreground"))
    features = options.density_features()

    def measure(feature: LocalFeature, image: MaskedPhotograph) -> Row:
        keypoints, _ = run.keypoints(feature, image.image)
        mask = load_mask(image.mask)
        if mask.shape[::-1] != keypoints.image_size:
            raise ImageError(f"the mask {image.mask.name} and its photograph differ in size")
        fraction = foreground_fraction(keypoints.xy, mask)  # NaN if there are no keypoints
        return {"fraction": fraction, "density": keypoints.density, "covered": float(mask.mean())}

    items = {each.image.name: each for each in images}
    rows = run.rows("foreground of ", features, items, measure)
    for feature in features:
        own = where(rows, method=feature.name)
        if empty := sum(row["fraction"] != row["fraction"] for row in own):  # NaN
            run.skipped.append(f"foreground of {feature.title}: {empty} images have no keypoint")

    def over_chance(own: Rows) -> Cell:
        known = [row for row in own if row["fraction"] == row["fraction"]]
        fraction, chance = mean(known, "fraction"), mean(known, "covered")
        return None if fraction is None or not chance else fraction / chance

    title = "fraction on the foreground"
    columns: Columns = {
        title: average(".4f", "fraction"),
        "over that of random points": (".2f", over_chance),
        "keypoints per pixel": average(".4f", "density"),
    }
    covered = {row["item"]: row["covered"] for row in rows}
    note = (
        f"{len(covered)} images. Their foreground covers {mean_of(covered.values()) or 0:.1%} of "
        "the pixels, so this fraction of random points would be on it. The paper used 18 images "
        "that are not published."
    )
    table = tabulate("foreground", "Keypoints on the foreground", features, rows, columns, note)
    table = with_paper_column(table, title, FOREGROUND)
    return [Section("Foreground (Table I)", (), [table])]


def pair_repeatability(run: Run, feature: LocalFeature, pair: PlanarPair) -> float:
    """Return the repeatability of a feature on a pair, as the paper defines it."""
    images = (pair.first, pair.second)

    def make() -> Row:
        first, second = (run.keypoints(feature, image)[0].xy for image in images)
        return {"value": repeatability_paper(first, second, pair.homography)}

    depends = (feature.detection, images, pair.homography)
    return float(run.cached("repeatability_paper", depends, make)["value"])


def correct_matches(run: Run, feature: LocalFeature, pair: PlanarPair) -> tuple[int, int]:
    """Return the numbers of correct matches and of all matches of a pair."""
    found = run.matches(feature, (pair.first, pair.second), PAPER_MATCHING)
    errors = transfer_errors(found.points0, found.points1, pair.homography)
    return int(np.count_nonzero(errors < CORRECT_PX)), len(errors)


def keypoint_figure(run: Run, features: Sequence[LocalFeature], scene: PlanarScene) -> Figure:
    """Draw the paper's Figure 2 for a scene: the keypoints of each feature in the first image."""
    image = scene.images[0]
    rgb = load_image(image)
    panels, counts = [], []
    for feature in features:
        found, _ = run.keypoints(feature, image)
        inside = np.clip(np.rint(found.xy), 0, np.array(found.image_size) - 1)
        drawn = Keypoints(inside, found.scores, found.image_size).draw(rgb)
        counts.append(f"{feature.title} {len(found):,}")
        panels.append(add_caption(drawn, f"{feature.title}: {len(found):,}"))
    title = f"Figure 2: keypoints of {scene.name}: {'; '.join(counts)}"
    return Figure(f"keypoints_{scene.name}", title, picture(join_pictures(panels, len(panels))))


def mask_figure(scene: PlanarScene) -> Figure:
    """Draw the paper's Figure 4: an image, its keypoint mask, its edge mask, and both combined."""
    from ...labels import draw_label, fuse

    rgb = load_image(scene.images[0])
    title = f"Figure 4: keypoint and edge masks, and both combined ({scene.name})"
    return Figure("masks", title, picture(draw_label(rgb, fuse(luma(rgb)))))


def match_figure(run: Run, feature: LocalFeature, number: str, pair: PlanarPair) -> Figure:
    """Draw Figure 6 or 7 of the paper: a random sample of a pair's matches, correct ones green."""
    found = run.matches(feature, (pair.first, pair.second), PAPER_MATCHING)
    correct = transfer_errors(found.points0, found.points1, pair.homography) < CORRECT_PX
    drawn = draw_matches(
        load_image(pair.first), load_image(pair.second), found.points0, found.points1, correct
    )
    precision = correct.mean() if len(correct) else 0.0
    title = (
        f"{number}: {feature.title}, {pair.name}: {len(correct):,} matches, "
        f"{int(correct.sum()):,} correct ({precision:.1%}); a random sample is drawn"
    )
    return Figure(f"matches_{pair.name.replace(' ', '_')}", title, picture(drawn))
