"""Data sets with ground truth. To add one, write a module here and add a line below."""

from collections.abc import Callable

from .._shared.registry import look_up
from .coco import COCO
from .download import RemoteDataset, RemoteFile, get_dataset
from .hpatches import HPATCHES
from .middlebury import MIDDLEBURY, load_motorcycle
from .oxford import OXFORD
from .photographs import PHOTOGRAPHS, PHOTOGRAPHS_FREE
from .posed_images import PosedImage, PosedScene, load_posed_scenes
from .types import StereoPair

STEREO_PAIRS: dict[str, Callable[[], StereoPair]] = {
    "motorcycle": load_motorcycle,
}

REMOTE_DATASETS: dict[str, RemoteDataset] = {
    dataset.name: dataset
    for dataset in (COCO, PHOTOGRAPHS, PHOTOGRAPHS_FREE, OXFORD, HPATCHES, MIDDLEBURY)
}


def find_remote_dataset(name: str) -> RemoteDataset:
    """Look a data set on the web up by name.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("data set", name, REMOTE_DATASETS)


def load_stereo_pair(name: str) -> StereoPair:
    """Load a stereo pair by name.

    Raises:
        OptionError: the name is unknown.
    """
    return look_up("stereo pair", name, STEREO_PAIRS)()


__all__ = [
    "REMOTE_DATASETS",
    "STEREO_PAIRS",
    "PosedImage",
    "PosedScene",
    "RemoteDataset",
    "RemoteFile",
    "StereoPair",
    "find_remote_dataset",
    "get_dataset",
    "load_posed_scenes",
    "load_stereo_pair",
]
