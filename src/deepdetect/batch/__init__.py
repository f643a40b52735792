"""Collections of photographs: features and matches of many files, in the files of hloc."""

from .engines import ENGINES, get_engine
from .extraction import ExtractionReport, extract_features
from .pair_list import pair_name, read_pairs
from .pair_matching import PairMatchingOptions, PairMatchingReport, match_pairs

__all__ = [
    "ENGINES",
    "ExtractionReport",
    "PairMatchingOptions",
    "PairMatchingReport",
    "extract_features",
    "get_engine",
    "match_pairs",
    "pair_name",
    "read_pairs",
]
