"""Disparities of rectified pairs."""

from .row_matching import COMPLETE, RowMatches, RowMatchingOptions, match_rows
from .semi_global import SearchRange

__all__ = ["COMPLETE", "RowMatches", "RowMatchingOptions", "SearchRange", "match_rows"]
