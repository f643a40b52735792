"""`deepdetect datasets`: data sets on the web."""

from __future__ import annotations

from pathlib import Path

import click

from ._options import PATH, json_option, print_json, print_result, print_table


@click.group(short_help="Download data sets.")
def datasets() -> None:
    """Download data sets for training and for the benchmarks."""


@datasets.command("list", short_help="Show the available data sets.")
@json_option
def list_datasets(as_json: bool) -> None:
    """Show the data sets that can be downloaded."""
    from ..datasets import remote_datasets

    if as_json:
        print_json(
            [
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
        )
        return
    for dataset in remote_datasets().values():
        rows = [
            ("images", f"{dataset.images:,}"),
            ("download", f"{dataset.size / 1e9:.1f} GB, and as much again unpacked"),
            ("licence", dataset.licence),
        ]
        print_table(rows, f"{dataset.name}: {dataset.title}")


@datasets.command(short_help="Download and unpack a data set.")
@click.argument("name")
@click.option("-o", "--output", type=PATH, help="Folder for the images.  [default: data/NAME]")
@json_option
def get(name: str, output: Path | None, as_json: bool) -> None:
    """Download the data set NAME and unpack it.

    Run it again to resume a download that broke off.

    \b
    deepdetect datasets get coco
    deepdetect train --preset paper data/coco -o run
    deepdetect datasets get photographs-free
    deepdetect datasets get oxford
    deepdetect benchmark oxford --data data -o report
    """
    from ..datasets import find_remote_dataset, get_dataset
    from ..io.image import find_images

    dataset = find_remote_dataset(name)
    folder = get_dataset(dataset, output or Path("data") / dataset.name, quiet=as_json)
    images = len(find_images(folder))
    print_result(
        as_json,
        {"name": dataset.name, "folder": folder, "images": images},
        [("images", f"{images:,}"), ("written", str(folder)), ("licence", dataset.licence)],
    )
