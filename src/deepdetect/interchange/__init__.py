"""Keypoints and matches in the files of other programs: COLMAP, hloc, OpenCV, Bundler."""

from .collection import Collection, PairMatches, describe_collection
from .formats import FORMATS, get_format
from .sources import match_photographs, read_collection

__all__ = [
    "FORMATS",
    "Collection",
    "PairMatches",
    "describe_collection",
    "get_format",
    "match_photographs",
    "read_collection",
]
