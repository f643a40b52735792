"""Matchers: which descriptor of one image is like which of the other."""

from .ratio import DescriptorMatches, match_descriptors, one_to_one
from .registry import MATCHERS, Matcher, get_matcher

__all__ = [
    "MATCHERS",
    "DescriptorMatches",
    "Matcher",
    "get_matcher",
    "match_descriptors",
    "one_to_one",
]
