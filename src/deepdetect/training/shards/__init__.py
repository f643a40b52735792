"""Photographs with their labels in shards, for sets too big for the memory.

A shard is a tar file in WebDataset's layout: of every photograph the file as it was, its
name, and the labels of its views. Shards are read one after the other, in an order of their
own each epoch, some at a time, whose photographs are mixed.
"""

from .index import Shards, has_shards
from .reading import HeldExamples, ShardFeed
from .writing import write_shards

__all__ = ["HeldExamples", "ShardFeed", "Shards", "has_shards", "write_shards"]
