"""Options that choose and configure a detector."""

from __future__ import annotations

from dataclasses import replace
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
    Kind,
    Parameter(
        help="'network' selects pixels of the network's heat map; 'points' ranks points of all "
        "scales and takes the best."
    ),
]

NETWORK = From(
    DeepDetect,
    "weights",
    more="resolution backend device threads precision tta tile_megapixels",
    types={"weights": str, "backend": Literal[("auto", *BACKENDS)]},
    defaults={"threads": "the backend's choice"},
)
POINTS = From(PointDetector, more="spread ranker")
ONE_THREAD = replace(NETWORK, defaults={"threads": "1"})
"""Options of the network for commands that run one detector with one thread in each process."""

DESCRIBED_POINTS = From(PointDetector, more="spread ranker descriptor")
SELECTION = From(
    SelectionOptions,
    "max_keypoints threshold density",
    defaults={"max_keypoints": "2048 with --detector points, else all"},
)


def chosen_detector(
    kind: Kind,
    values: dict[str, Any],
    *,
    max_keypoints: int = 2048,
    options: From = POINTS,
    **defaults: Any,
) -> tuple[DeepDetect | PointDetector, SelectionOptions | None]:
    """Return the detector `kind` and its selection options, which are None for "points".

    The options of both detectors are removed from `values`; `options` lists the options of
    "points". `max_keypoints` is the default for "points", and `defaults` are those for the network.
    """
    network, points, selection = (source.take(values) for source in (NETWORK, options, SELECTION))
    if kind == "points":
        points["max_keypoints"] = selection.pop("max_keypoints", max_keypoints)
        shared = network.keys() & {"resolution", "backend", "device", "threads"}
        points |= {name: network.pop(name) for name in shared}
    for name in (*network, *selection) if kind == "points" else points:
        other = "network" if kind == "points" else "points"
        raise OptionError(
            f"`{name}` is for --detector {other}: leave it out, or choose that detector"
        )
    if kind == "points":
        return PointDetector(**points), None
    return DeepDetect(**{**defaults, **network}), SelectionOptions(**selection)
