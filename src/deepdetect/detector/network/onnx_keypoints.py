"""The best dense keypoints as outputs of an ONNX file, found in its graph.

They are those of `select_keypoints` with `max_keypoints`: the highest of 3x3 pixels, where the
logit is above 0, and at the maximum of a parabola through the logits of a pixel and its neighbours.
All tensors that are made here, and no others, have names that begin with `PREFIX`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ...features.keypoints import bayer_order
from ...features.selection import MAX_OFFSET_PX
from ..pretrained import KEYPOINT_LOGITS, KEYPOINTS, LOGITS
from .onnx_graph import add_constants, replace_nodes

if TYPE_CHECKING:
    from onnx import ModelProto, NodeProto

PREFIX = "keypoint"

MAX_KEYPOINTS = 2048
"""How many a file for any size gives, the shipped ones, too."""

NO_POSITION, NO_LOGIT = -1.0, -np.inf
"""What the rows hold behind the last keypoint of an image that has fewer than the file gives."""

CANDIDATES = 2
"""Pixels that are looked at for each wanted keypoint: of neighbours that are equal one is kept.

Logits in float32 hardly ever are.
"""

NEIGHBOURS = np.array([[-1, 0], [0, -1], [1, 0], [0, 1], [-1, -1], [1, -1], [-1, 1], [1, 1]])
"""Steps in x and y: to the pixels before in x and in y, those behind, and those at the corners."""


def add_keypoints(model: ModelProto, max_keypoints: int) -> None:
    """Let a network with float32 `logits`, of any size or of one, give the best keypoints, too.

    `keypoints` are (batch, N, 2) float32, x and y in pixels; `keypoint_logits` (batch, N) float32,
    the highest first. Behind the last keypoint of an image they are -1 and -infinity.
    """
    from onnx import TensorProto, helper

    graph = model.graph
    logits = next(value for value in graph.output if value.name == LOGITS)
    batch, _, _, width = (
        side.dim_param or side.dim_value for side in logits.type.tensor_type.shape.dim
    )
    count = CANDIDATES * max_keypoints
    whole: dict[str, Any] = {
        "frame": [0, 0, 1, 1, 0, 0, 1, 1],
        "in_a_row": [0, -1],
        "behind": [0, 0, 0, count],
        "candidates": [count],
        "wanted": [max_keypoints],
        "first": 0,
        "two": 2,
        "last_axis": [2],
        "around": [0, count, len(NEIGHBOURS)],
        "sides": [2, 2, 4],
        **({"width": width} if isinstance(width, int) else {"third": 3}),
        "steps_right": NEIGHBOURS[:, 0] + 1,
        "steps_down": NEIGHBOURS[:, 1] + 1,
    }
    real = {
        "zero": 0,
        "least": NO_LOGIT,
        "nowhere": NO_POSITION,
        "most": np.inf,
        "twice": 2,
        "furthest_back": -MAX_OFFSET_PX,
        "furthest": MAX_OFFSET_PX,
        "precedence": _precedence(),
    }
    for values, kind in ((whole, np.int64), (real, np.float32)):
        add_constants(graph, {f"{PREFIX}_{name}": one for name, one in values.items()}, kind)
    sizes = [_node("Shape", LOGITS, "shape"), _node("Gather", "shape third", "width")]
    nodes = _keypoints() if isinstance(width, int) else [*sizes, *_keypoints()]
    replace_nodes(graph, [*graph.node, *nodes])
    for name, shape in (
        (KEYPOINTS, (batch, max_keypoints, 2)),
        (KEYPOINT_LOGITS, (batch, max_keypoints)),
    ):
        graph.output.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, shape))


def remove_keypoints(model: ModelProto) -> None:
    """Undo `add_keypoints`; other networks stay as they are."""
    graph = model.graph
    kept = [value for value in graph.output if value.name not in (KEYPOINTS, KEYPOINT_LOGITS)]
    if len(kept) == len(graph.output):
        return
    del graph.output[:]
    graph.output.extend(kept)
    replace_nodes(graph, [node for node in graph.node if not node.output[0].startswith(PREFIX)])


def _keypoints() -> list[NodeProto]:
    """Make the nodes that find the best keypoints."""
    return [
        # The best pixels that no neighbour exceeds: `value`, `pixel`.
        _node("Pad", f"{LOGITS} frame least", "framed"),
        _node("MaxPool", "framed", "highest", kernel_shape=[3, 3]),
        _node("Equal", f"{LOGITS} highest", "is_highest"),
        _node("Where", f"is_highest {LOGITS} least", "peaks"),
        _node("Reshape", "peaks in_a_row", "peaks_in_a_row"),
        _node("Pad", "peaks_in_a_row behind least", "peaks_and_more"),
        _node("TopK", "peaks_and_more candidates", "values numbers", axis=1),
        _node("Unsqueeze", "values last_axis", "value"),
        _node("Unsqueeze", "numbers last_axis", "number"),
        _node("Greater", "value zero", "passing"),
        _node("Where", "passing number first", "pixel"),  # some are behind the last pixel
        # The logits around each of them: `column`, `row`, `neighbours`.
        _node("Mod", "pixel width", "column"),
        _node("Div", "pixel width", "row"),
        # In the framed logits, whose rows are two pixels longer.
        _node("Add", "width two", "framed_width"),
        _node("Mul", "row two", "frame_above"),
        _node("Add", "pixel frame_above", "corner"),
        _node("Mul", "steps_down framed_width", "rows_down"),
        _node("Add", "rows_down steps_right", "steps"),
        _node("Add", "corner steps", "places"),
        _node("Reshape", "places in_a_row", "places_in_a_row"),
        _node("Reshape", "framed in_a_row", "framed_in_a_row"),
        _node("GatherElements", "framed_in_a_row places_in_a_row", "found_in_a_row", axis=1),
        _node("Reshape", "found_in_a_row around", "neighbours"),
        # Of equal neighbours all but one are dropped.
        _node("Mod", "column two", "odd_column"),
        _node("Mod", "row two", "odd_row"),
        _node("Mul", "odd_row two", "parity_of_row"),
        _node("Add", "parity_of_row odd_column", "parity"),
        _node("Squeeze", "parity last_axis", "parities"),
        _node("Gather", "precedence parities", "taking_precedence"),
        _node("Add", "neighbours taking_precedence", "rivals"),
        _node("ReduceMax", "rivals", "rival", axes=[2]),
        _node("Greater", "value rival", "unrivalled"),
        _node("And", "unrivalled passing", "kept"),
        # Differences of near numbers are exact, a sum of three would be rounded.
        _node("Split", "neighbours sides", "before after corners", axis=2),
        _node("Sub", "value before", "rise"),
        _node("Sub", "value after", "fall"),
        _node("Add", "rise fall", "bend"),
        _node("Greater", "bend zero", "bent"),
        _node("Less", "bend most", "inner"),  # beyond the border is -infinity
        _node("And", "bent inner", "refined"),
        _node("Sub", "rise fall", "slope"),
        _node("Mul", "bend twice", "curvature"),
        _node("Div", "slope curvature", "any_offset"),
        _node("Clip", "any_offset furthest_back furthest", "small_offset"),
        _node("Where", "refined small_offset zero", "offset"),
        _node("Concat", "column row", "centre", axis=2),
        _node("Cast", "centre", "centre_as_float", to=1),
        _node("Add", "centre_as_float offset", "position"),
        _node("Where", "kept position nowhere", "positions"),
        _node("Where", "kept value least", "kept_value"),
        _node("Squeeze", "kept_value last_axis", "kept_values"),
        _node("TopK", "kept_values wanted", f"{KEYPOINT_LOGITS} order", axis=1),
        _node("Unsqueeze", "order last_axis", "place"),
        _node("Concat", "place place", "place_of_x_and_y", axis=2),
        _node("GatherElements", "positions place_of_x_and_y", KEYPOINTS, axis=1),
    ]


def _node(kind: str, inputs: str, outputs: str, **attributes: Any) -> NodeProto:
    """Make a node; the prefix is added to the names of tensors that lack it."""
    from onnx import helper

    read, written = (
        [
            name if name == LOGITS or name.startswith(PREFIX) else f"{PREFIX}_{name}"
            for name in names.split()
        ]
        for names in (inputs, outputs)
    )
    return helper.make_node(kind, read, written, **attributes)


def _precedence() -> np.ndarray:
    """Return 0 for neighbours that win against a pixel that is equal, -infinity for the others.

    Of neighbours the lowest bits of their positions decide in `bayer_order`: the rows are those of
    an even or odd column (+1) and row (+2), the columns `NEIGHBOURS`.
    """
    pixels = np.array([[2, 2], [3, 2], [2, 3], [3, 3]])
    own = bayer_order(pixels, (8, 8))
    others = bayer_order((pixels[:, None] + NEIGHBOURS).reshape(-1, 2), (8, 8)).reshape(4, 8)
    return np.where(others < own[:, None], 0, -np.inf)
