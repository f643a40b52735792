"""`deepdetect shards`: images with their labels in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import generated_command
from ._options import (
    PATH,
    SHARDS,
    chosen_recipe,
    json_option,
    print_json,
    print_table,
    recipe_options,
    workers_option,
)


@generated_command(SHARDS, short_help="Pack images for training on sets too big for the memory.")
@click.argument("images", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder for the shards.")
@recipe_options
@click.option(
    "--shard-size",
    type=click.IntRange(min=1),
    default=256,
    show_default=True,
    help="About this many images go into a shard.",
)
@workers_option
@json_option
def shards(
    images: Path,
    output: Path,
    preset: str,
    detectors: str | None,
    label_settings: str | None,
    shard_size: int,
    workers: int | None,
    as_json: bool,
    **values: Any,
) -> None:
    """Pack the images in the folder IMAGES with their labels into tar files.

    They are in WebDataset's layout. Training reads a few of them at a time, so they may be
    on a slow disk or a network. Give both commands the same options. When it is interrupted,
    the same command resumes.

    \b
    deepdetect shards --preset paper data/coco -o data/shards
    deepdetect train --preset paper data/shards -o run
    """
    from ..training import Stage, write_shards

    # Shards are for any stages: one that fits every size stands for them.
    values["stages"] = (Stage(16, 1, 1),)
    options = chosen_recipe(preset, detectors, label_settings, values)
    made = write_shards(
        images,
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
            ("to train on", f"{counts['training']:,} images in {len(made.training)} shards"),
            ("to validate with", f"{counts['validation']:,} images"),
            ("written", f"{output}, {size / 1e6:,.1f} MB"),
        ]
    )
