"""Read data sets with ground truth, and download the data sets that `known/datasets.json` lists."""

import json
from functools import cache, partial
from importlib import resources
from typing import Any

from . import photographs
from .download import RemoteDataset, RemoteFile, get_dataset
from .middlebury import StereoPair, load_motorcycle
from .posed_images import PosedImage, PosedScene, load_posed_scenes


@cache
def remote_datasets() -> dict[str, RemoteDataset]:
    """Return the data sets that can be downloaded, by name."""
    return {name: _remote_dataset(name, **entry) for name, entry in _known("datasets").items()}


def _known(name: str) -> Any:
    file = resources.files(__package__).joinpath(f"known/{name}.json")
    return json.loads(file.read_text("utf-8")) if file.is_file() else {}


def _remote_dataset(name: str, files: Any = (), texts: Any = None, **values: Any) -> RemoteDataset:
    if name.startswith("photographs"):
        free = name.endswith("free")
        crops = [crop for crop in photographs.listed_crops() if crop.is_free or not free]
        used = {crop.source for crop in crops}
        sources = photographs.listed_sources()
        archives = tuple(sources[each].archive for each in sources if each in used)
        prepare = partial(photographs.write_crops, crops=crops)
        return RemoteDataset(name, files=archives, prepare=prepare, **values)
    made = tuple(RemoteFile(**{**file, "urls": tuple(file["urls"])}) for file in files)
    written = {path: json.dumps(value, indent=1) + "\n" for path, value in (texts or {}).items()}
    return RemoteDataset(name, files=made, contents=_known(name), texts=written, **values)


__all__ = [
    "PosedImage",
    "PosedScene",
    "RemoteDataset",
    "RemoteFile",
    "StereoPair",
    "get_dataset",
    "load_motorcycle",
    "load_posed_scenes",
    "remote_datasets",
]
