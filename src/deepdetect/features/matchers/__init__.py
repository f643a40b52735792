"""Matchers: nearest neighbours of descriptors, and the matches that follow from them."""

from .matching import (
    MATCHERS,
    DescriptorMatches,
    Matcher,
    get_matcher,
    match_descriptors,
)

__all__ = [
    "MATCHERS",
    "DescriptorMatches",
    "Matcher",
    "get_matcher",
    "match_descriptors",
]
