"""Commands of `deepdetect dev datasets`, which download data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from deepdetect._shared.options import look_up
from deepdetect.cli._options import Output, Result, command, table
from deepdetect.io.image import find_images

from ..datasets import get_dataset, remote_datasets

datasets = App("datasets", help="Download data sets for training and for the benchmarks.")


@datasets.command(name="list")
@command()
def list_datasets() -> Result:
    """Show the data sets that can be downloaded."""
    values = [
        {
            **{name: getattr(each, name) for name in ("name", "title", "images", "licence")},
            "bytes": each.size,
            "urls": [url for file in each.files for url in file.urls],
        }
        for each in remote_datasets().values()
    ]
    return Result(values, "\n\n".join(table({**each, "urls": None}) for each in values))


@datasets.command
@command()
def get(
    name: Annotated[str, Parameter(help=f"One of {', '.join(remote_datasets())}.")],
    /,
    *,
    output: Output | None = None,
) -> Result:
    """Download a data set and unpack it.

    Run the command again to resume an interrupted download.

        deepdetect dev datasets get coco
        deepdetect train --preset paper data/coco -o run
        deepdetect dev datasets get oxford
        deepdetect dev benchmark oxford --data data -o report

    Args:
        output: Folder for the images.  [default: data/NAME]
    """
    dataset = look_up("data set", name, remote_datasets())
    folder = get_dataset(dataset, output or Path("data") / dataset.name, quiet=False)
    images = len(find_images(folder))
    values = {"name": name, "folder": folder, "images": images, "licence": dataset.licence}
    return Result(values)
