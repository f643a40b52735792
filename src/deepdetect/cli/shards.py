"""`deepdetect shards`: photographs with their labels in files that training can stream."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from .recipe import (
    augmentations_option,
    chosen_recipe,
    detectors_option,
    preset_option,
    short_sides_option,
)
from .shared import (
    PATH,
    json_option,
    label_settings_option,
    print_json,
    print_table,
    workers_option,
)


@click.command(short_help="Pack photographs for training on sets too big for the memory.")
@click.argument("photos", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder for the shards.")
@preset_option
@short_sides_option
@augmentations_option
@detectors_option
@label_settings_option
@click.option(
    "--shard-size",
    type=click.IntRange(min=1),
    default=256,
    show_default=True,
    help="About so many; each process holds eight shards in memory.",
)
@workers_option
@json_option
def shards(
    photos: Path,
    output: Path,
    preset: str,
    detectors: str | None,
    label_settings: str | None,
    shard_size: int,
    workers: int | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Pack the photographs in the folder PHOTOS with their labels into tar files.

    They are in WebDataset's layout. Training reads them one after the other, so they may lie
    on a slow disk or a network. Give both commands the same options. Given again, the
    command goes on where it was broken off.

    \b
    deepdetect shards --preset paper data/coco -o data/shards
    deepdetect train --preset paper data/shards -o run
    """
    from ..training.recipe import Stage
    from ..training.shards import write_shards

    # Shards are for any stages: one that fits every size stands for them.
    values["stages"] = (Stage(16, 1, 1),)
    options = chosen_recipe(preset, detectors, label_settings, values)
    made = write_shards(
        photos,
        output,
        options,
        shard_size=shard_size,
        workers=workers,
        quiet=as_json,
    )
    counts = {
        kind: sum(count for _, count in files)
        for kind, files in (("training", made.training), ("validation", made.validation))
    }
    size = sum(path.stat().st_size for path, _ in made.training + made.validation)
    if as_json:
        print_json({"folder": output, **counts, "bytes": size})
        return
    print_table(
        [
            ("to train on", f"{counts['training']:,} photographs in {len(made.training)} shards"),
            ("to validate with", f"{counts['validation']:,} photographs"),
            ("written", f"{output}, {size / 1e6:,.1f} MB"),
        ]
    )
