"""`deepdetect shards`: images with their labels in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from ._generated import FieldOptions, generated_command, given_only
from ._options import (
    PATH,
    SHARDS,
    chosen_recipe,
    engine_option,
    json_option,
    print_result,
    recipe_options,
    workers_option,
)

WRITING = FieldOptions("training.shards:write_shards", names=("shard_size",))


@generated_command(SHARDS, WRITING, short_help="Pack images for training on large sets.")
@click.argument("images", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Folder for the shards.")
@recipe_options
@engine_option
@workers_option
@json_option
def shards(
    images: Path,
    output: Path,
    preset: str,
    detectors: str | None,
    label_settings: str | None,
    engine: str,
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
    from ..batch.engines import get_engine
    from ..training import Stage, write_shards
    from ._records import check_none_made

    check_none_made(images, output)
    # Shards are for any stages: one that fits every size stands for them.
    values["stages"] = (Stage(16, 1, 1),)
    chosen = given_only({name: values.pop(name) for name in WRITING.names})
    options = chosen_recipe(preset, detectors, label_settings, values)
    made = write_shards(
        images,
        output,
        options,
        workers=workers,
        quiet=as_json,
        map_tasks=get_engine(engine),
        **chosen,
    )
    counts = {
        kind: sum(count for _, count in files)
        for kind, files in (("training", made.training), ("validation", made.validation))
    }
    size = sum(path.stat().st_size for path, _ in made.training + made.validation)
    print_result(
        as_json,
        {"folder": output, **counts, "bytes": size},
        [
            ("to train on", f"{counts['training']:,} images in {len(made.training)} shards"),
            ("to validate with", f"{counts['validation']:,} images"),
            ("written", f"{output}, {size / 1e6:,.1f} MB"),
        ],
    )
