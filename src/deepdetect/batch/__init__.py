"""Features and matches of collections of images, in files in hloc's layout."""

from .engines import ENGINES
from .extraction import extract_features
from .hdf5 import BatchReport
from .pair_list import pair_name, read_pairs
from .pair_matching import PairMatchingOptions, match_pairs

__all__ = [
    "ENGINES",
    "BatchReport",
    "PairMatchingOptions",
    "extract_features",
    "match_pairs",
    "pair_name",
    "read_pairs",
]
