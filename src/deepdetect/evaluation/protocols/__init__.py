"""Benchmarks: every table and figure of the paper, and the controls they lack."""

from ..options import PROTOCOLS, BenchmarkOptions
from ..registry import BENCHMARKS
from ..report import Report, Section, Table
from ..run import run_benchmarks

__all__ = [
    "BENCHMARKS",
    "PROTOCOLS",
    "BenchmarkOptions",
    "Report",
    "Section",
    "Table",
    "run_benchmarks",
]
