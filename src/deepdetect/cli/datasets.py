"""`deepdetect datasets`: data sets on the web."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from ..datasets import find_remote_dataset, get_dataset, remote_datasets
from ..io.image import find_images
from ._options import Json, Output, print_json, print_result

datasets = App("datasets", help="Download data sets for training and for the benchmarks.")


@datasets.command(name="list")
def list_datasets(*, as_json: Json = False) -> None:
    """Show the data sets that can be downloaded."""
    values = [
        {
            "name": dataset.name,
            "title": dataset.title,
            "images": dataset.images,
            "bytes": dataset.size,
            "licence": dataset.licence,
            "urls": [url for file in dataset.files for url in file.urls],
        }
        for dataset in remote_datasets().values()
    ]
    if as_json:
        print_json(values)
        return
    for each in values:
        print_result(False, {**each, "urls": None})
        print()


@datasets.command
def get(
    name: Annotated[str, Parameter(help=f"One of {', '.join(remote_datasets())}.")],
    /,
    *,
    output: Output | None = None,
    as_json: Json = False,
) -> None:
    """Download a data set and unpack it.

    Run it again to resume a download that broke off.

        deepdetect datasets get coco
        deepdetect train --preset paper data/coco -o run
        deepdetect datasets get oxford
        deepdetect benchmark oxford --data data -o report

    Args:
        output: Folder for the images.  [default: data/NAME]
    """
    dataset = find_remote_dataset(name)
    folder = get_dataset(dataset, output or Path("data") / dataset.name, quiet=as_json)
    images = len(find_images(folder))
    values = {"name": dataset.name, "folder": folder, "images": images}
    print_result(as_json, values | {"licence": dataset.licence})
