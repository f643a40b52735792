"""`deepdetect shards`: images with their labels in files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from ..batch.engines import get_engine
from ..training import write_shards
from . import _options as cli
from ._training import SHARDS, Detectors, LabelSettings, Preset, chosen_recipe


@cli.with_options(SHARDS, cli.From(write_shards, "shard_size", common="shard_size"))
def shards(
    images: Annotated[Path, Parameter(help="Folder of the images.")],
    /,
    *,
    output: cli.Output,
    preset: Preset = "default",
    detectors: Detectors = None,
    label_settings: LabelSettings = None,
    engine: cli.Engine = "processes",
    workers: cli.Workers = None,
    as_json: cli.Json = False,
    **values: Any,
) -> None:
    """Pack the images in a folder with their labels into tar files.

    They are in WebDataset's layout. Training reads a few of them at a time, so they may be on a
    slow disk or a network. Give both commands the same options. When it is interrupted, the same
    command resumes.

        deepdetect shards --preset paper data/coco -o data/shards
        deepdetect train --preset paper data/shards -o run

    Args:
        output: Folder for the shards.
    """
    folder = cli.output_folder(output)
    cli.check_folder_not_made(images, folder)
    chosen = {name: values.pop(name) for name in ("shard_size",) if name in values}
    # Shards are for any stages: one that fits every size stands for them.
    options = chosen_recipe(preset, detectors, label_settings, {**values, "stages": ["16x1x1"]})
    made = write_shards(
        images,
        folder,
        options,
        workers=workers,
        quiet=as_json,
        map_tasks=get_engine(engine),
        **chosen,
    )
    values = {
        "folder": folder,
        "training": sum(count for _, count in made.training),
        "validation": sum(count for _, count in made.validation),
        "shards": len(made.training) + len(made.validation),
        "bytes": sum(path.stat().st_size for path, _ in made.training + made.validation),
    }
    cli.print_result(as_json, values)
