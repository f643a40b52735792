"""Options that choose and set a detector."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from cyclopts import Parameter

from .._shared.errors import OptionError
from ..detector.backends import BACKENDS
from ..detector.detector import DeepDetect
from ..detector.point_detector import PointDetector
from ..features.selection import SelectionOptions
from ._options import From

Kind = Literal["network", "points"]
Detector = Annotated[
    Kind, Parameter(help="Pixels of the network's heat map, or ranked points of all scales.")
]

NETWORK = From(
    DeepDetect,
    "weights resolution backend device threads precision tta tile_megapixels",
    common="weights",
    types={"weights": str, "backend": Literal[("auto", *BACKENDS)]},
    defaults={"threads": "the backend's choice"},
)
POINTS = From(PointDetector, "spread ranker")
SELECTION = From(
    SelectionOptions,
    common="max_keypoints threshold density",
    defaults={"max_keypoints": "2048 with --detector points, else all"},
)


def chosen_detector(
    kind: Kind, values: dict[str, Any], *, max_keypoints: int = 2048, **defaults: Any
) -> tuple[DeepDetect | PointDetector, SelectionOptions | None]:
    """Make the detector that is chosen, and its selection, taking their options out of the values.

    Args:
        kind: "network" or "points".
        values: of `NETWORK`, `POINTS` and `SELECTION`.
        max_keypoints: of points, where nothing else is given.
        defaults: of the network, where nothing else is given.

    Raises:
        OptionError: an option is of the other detector.
    """
    network, points, selection = (source.take(values) for source in (NETWORK, POINTS, SELECTION))
    if kind == "points":
        common = {name: network.pop(name) for name in ("resolution",) if name in network}
        points = {"max_keypoints": max_keypoints, **common, **points}
        points |= {n: selection.pop(n) for n in ("max_keypoints",) if n in selection}
    for name in (*network, *selection) if kind == "points" else points:
        other = "network" if kind == "points" else "points"
        raise OptionError(f"`{name}` is for --detector {other}: leave it out, or choose that")
    if kind == "points":
        return PointDetector(**points), None
    return DeepDetect(**{**defaults, **network}), SelectionOptions(**selection)
