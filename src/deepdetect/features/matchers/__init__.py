"""Matchers: which descriptor of one image is like which of the other."""

from .matching import (
    MATCHERS,
    DescriptorMatches,
    Matcher,
    get_matcher,
    match_descriptors,
    unique_matches,
)

__all__ = [
    "MATCHERS",
    "DescriptorMatches",
    "Matcher",
    "get_matcher",
    "match_descriptors",
    "unique_matches",
]
