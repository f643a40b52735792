"""How many photographs become cameras and points: all options at once."""

from __future__ import annotations

from dataclasses import dataclass, field

from .._shared.options import check_ranges, suggest_keywords
from ..batch.pair_matching import PairMatchingOptions
from .fusion import DenseOptions
from .mapping import MappingOptions
from .pair_selection import PairSelectionOptions


def _matching() -> PairMatchingOptions:
    return PairMatchingOptions(ratio=0.85, mutual=True)


@suggest_keywords
@dataclass(frozen=True, eq=False)
class MultiViewOptions:
    """How many photographs become cameras and points.

    Attributes:
        pair_selection: which photographs are matched with each other.
        matching: of their keypoints.
        mapping: of cameras and sparse points.
        dense: of dense points; None: there are none.
        single_camera: whether photographs of one size were taken by one camera; None: where their
            EXIF gives one focal length, or none.

    Raises:
        OptionError: a value is out of its range.
    """

    pair_selection: PairSelectionOptions = field(default_factory=PairSelectionOptions)
    matching: PairMatchingOptions = field(default_factory=_matching)
    mapping: MappingOptions = field(default_factory=MappingOptions)
    dense: DenseOptions | None = field(default_factory=DenseOptions)
    single_camera: bool | None = None

    def __post_init__(self) -> None:
        check_ranges(self)
