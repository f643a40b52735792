"""Export of keypoints and matches to the files of other programs: COLMAP, hloc."""

from .collection import Collection, PairMatches, describe_collection
from .colmap import write_colmap, write_colmap_text
from .hloc import write_hloc
from .sources import match_folder, read_collection

__all__ = [
    "Collection",
    "PairMatches",
    "describe_collection",
    "match_folder",
    "read_collection",
    "write_colmap",
    "write_colmap_text",
    "write_hloc",
]
