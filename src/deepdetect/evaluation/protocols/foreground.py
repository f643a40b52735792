"""Table I's second half: which share of the keypoints lies on the foreground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..._shared.errors import ImageError
from ...datasets.foreground import MaskedPhotograph
from ..baselines import Method
from ..metrics.spread import foreground_share
from ..report import Cell, Column, Table
from ..workspace import Workspace


def foreground_table(
    workspace: Workspace, methods: Sequence[Method], photographs: Sequence[MaskedPhotograph]
) -> Table:
    """Tabulate the share on the foreground, mean over the photographs, and the density."""
    covered = {each.image: float(each.foreground().mean()) for each in photographs}
    rows: list[tuple[Cell, ...]] = []
    for method in methods:
        shares, by_chance, densities = [], [], []
        for photograph in photographs:
            found = workspace.attempt(
                f"foreground of {method.title} on {photograph.image.name}",
                _measure,
                workspace,
                method,
                photograph,
            )
            workspace.done(1, f"{method.name}, {photograph.image.name}")
            if found is not None:
                shares.append(found[0])
                by_chance.append(covered[photograph.image])
                densities.append(found[1])
        known = [share for share in shares if share == share]
        # Random points, on the same photographs.
        chance = [c for c, share in zip(by_chance, shares, strict=True) if share == share]
        if len(known) < len(shares):
            workspace.left_out.append(
                f"foreground of {method.title}: {len(shares) - len(known)} photographs without "
                "a keypoint"
            )
        rows.append(
            (
                method.title,
                float(np.mean(known)) if known else None,
                float(np.mean(known) / np.mean(chance)) if known else None,
                float(np.mean(densities)) if densities else None,
            )
        )
    columns = (
        Column("method"),
        Column("share on the foreground", ".4f"),
        Column("over that of random points", ".2f"),
        Column("keypoints a pixel", ".4f"),
    )
    mean = np.mean(list(covered.values()))
    note = (
        f"{len(photographs)} photographs; their foreground is {mean:.1%} of the pixels, "
        "which is what random points reach."
    )
    return Table("foreground", "Keypoints on the foreground", columns, tuple(rows), note)


def _measure(
    workspace: Workspace, method: Method, photograph: MaskedPhotograph
) -> tuple[float, float]:
    def make() -> dict[str, np.ndarray]:
        features = workspace.keypoints(method, photograph.image).features
        foreground = photograph.foreground()
        if foreground.shape[::-1] != features.image_size:
            raise ImageError(f"{photograph.mask.name} is not of the photograph's size")
        share = foreground_share(features.xy, foreground)
        return {"values": np.array([share, features.density])}

    images = (photograph.image, photograph.mask)
    share, density = workspace.metric("foreground 1", method, images, {}, make)["values"].tolist()
    return share, density
