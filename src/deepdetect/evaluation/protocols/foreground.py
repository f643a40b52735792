"""Table I's second half: which fraction of the keypoints lies on the foreground."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from ..._shared.errors import ImageError
from ...datasets.foreground import MaskedPhotograph
from ..baselines.method import LocalFeature
from ..context import BenchmarkContext
from ..metrics.coverage import foreground_fraction
from ..report import Cell, Column, Table
from ..tasks import Part, Shown, feature_part
from .paper_numbers import FOREGROUND, FOREGROUND_CAUSES, with_paper_column

FRACTION = "fraction on the foreground"


def foreground_part(
    context: BenchmarkContext,
    features: Sequence[LocalFeature],
    photographs: Sequence[MaskedPhotograph],
) -> Part:
    """Tabulate the fraction on the foreground, mean over the photographs, and the density."""
    named = {photograph.image.name: photograph for photograph in photographs}

    def summarize(found: Mapping[tuple[str, str], tuple[float, float]]) -> Shown:
        covered = {name: float(each.foreground().mean()) for name, each in named.items()}
        rows: list[tuple[Cell, ...]] = []
        for feature in features:
            images = [image for image in covered if (feature.name, image) in found]
            values = {image: found[feature.name, image] for image in images}
            # NaN where there is no keypoint; chance is of the same photographs.
            known = [image for image in images if values[image][0] == values[image][0]]
            if len(known) < len(images):
                context.skipped.append(
                    f"foreground of {feature.title}: {len(images) - len(known)} photographs "
                    "without a keypoint"
                )
            fraction = np.mean([values[image][0] for image in known]) if known else np.nan
            chance = np.mean([covered[image] for image in known]) if known else np.nan
            density = np.mean([density for _, density in values.values()]) if values else np.nan
            rows.append((feature.title, *map(float, (fraction, fraction / chance, density))))
        columns = (
            Column("method"),
            Column(FRACTION, ".4f"),
            Column("over that of random points", ".2f"),
            Column("keypoints per pixel", ".4f"),
        )
        mean = np.mean(list(covered.values()))
        note = (
            f"{len(photographs)} photographs; their foreground is {mean:.1%} of the pixels, "
            "which is what random points reach."
        )
        table = Table("foreground", "Keypoints on the foreground", columns, tuple(rows), note)
        return [with_paper_column(table, FRACTION, FOREGROUND, FOREGROUND_CAUSES)]

    return feature_part(
        features, named, "foreground of ", partial(photograph_foreground, context), summarize
    )


def photograph_foreground(
    context: BenchmarkContext, feature: LocalFeature, photograph: MaskedPhotograph
) -> tuple[float, float]:
    """Return the fraction of the keypoints on the foreground, NaN without any, and their density.

    Raises:
        ImageError: the mask is not of the photograph's size.
    """

    def make() -> dict[str, np.ndarray]:
        features = context.keypoints(feature, photograph.image).features
        foreground = photograph.foreground()
        if foreground.shape[::-1] != features.image_size:
            raise ImageError(f"{photograph.mask.name} is not of the photograph's size")
        fraction = foreground_fraction(features.xy, foreground)
        return {"values": np.array([fraction, features.density])}

    images = (photograph.image, photograph.mask)
    fraction, density = context.metric("foreground", feature, images, {}, make)["values"].tolist()
    return fraction, density
