"""Write the ONNX graph that detects points.

    python tools/points_graph.py
    python tools/points_graph.py --candidates web/points.onnx

The first command writes the package's file that `deepdetect export onnx` adds to a network. The
second one writes the file that the page in the browser runs. Steps, constants and weights are those
of `deepdetect.detector.points`: after a change there, write the package's file again.

On processors with bfloat16, OpenVINO computes convolutions, matrix products and the nodes before
them in bfloat16, and only the remaining nodes in float32. So the graph has no convolutions, except
for transposed ones, and only one matrix product, whose inputs are zeros and ones.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import onnx
from onnx import helper, numpy_helper

from deepdetect.detector.points.candidate_features import (
    DETERMINANT_FLOOR,
    GRADIENT_FLOOR,
    RING_POINTS,
    RING_RADII,
    STRENGTH_FLOOR,
    ring_offsets,
)
from deepdetect.detector.points.descriptor import STRIDE
from deepdetect.detector.points.detection import (
    CANDIDATES_PER_KEYPOINT,
    MIN_CANDIDATES,
    SIZE_PER_SIGMA,
    WINDOW_PER_LEVEL,
    least_distances,
)
from deepdetect.detector.points.hessian_scales import (
    ANGLE_OCTAVES,
    LEAST_RESPONSE,
    NMS_RADII,
    OCTAVES,
    SIGMAS_PX,
    VARIANCES,
)
from deepdetect.detector.points.ranker import MAX_DEVIATIONS, load_ranker
from deepdetect.detector.pretrained import (
    DESCRIBING,
    DESCRIPTORS,
    GRAY,
    MAX_KEYPOINTS,
    POINTS,
    POINTS_GRAPH,
    PREFIX,
)
from deepdetect.features.kernels import ATAN, BINS, RADIUS_PER_WINDOW
from deepdetect.features.learned import CONSTANT, FREQUENCIES, LENGTH
from deepdetect.features.selection import MAX_OFFSET_PX

OPSET, IR_VERSION = 17, 8
"""Versions of the operators and of the format, as in the network's file."""

LUMA, LUMA_UNIT = (9798.0, 19235.0, 3735.0), 32768.0
"""Weights of red, green and blue in OpenCV's luma. They are integers, so that sums are exact, and
the sum is divided by the unit."""

REACH_PER_SIGMA = 4
"""Radius of OpenCV's float32 Gaussian filters, in sigmas."""

FIRST, LAST = 1, len(SIGMAS_PX) - 3
"""First and last level that has candidates."""

UPRIGHT = f"{DESCRIBING}descriptors"
"""Name of the descriptors before their rotation, which a network computes."""

MARGIN = int(NMS_RADII.max()) + 1
"""Radius in pixels of the patch that is read around a candidate: that of the largest window of
non-maximum suppression, plus one pixel for derivatives."""

NEAR, OTHERS = np.arange(-1, 3), [0, 2, 3]
"""Levels that are read, relative to a candidate's own level; indices in `NEAR` of other levels."""

CHUNK = 2048
"""Number of candidates that are measured at once, because the patches of all candidates would take
70 MB and more."""

TOGETHER = 16
"""Number of neighbouring pixels that a convolution smooths at once, as its channels. Chosen by
hand."""

BLOCK = 256
"""Number of points that are compared with each other at once. Chosen by hand."""

END = 1 << 40
"""A slice to this index reaches the end of any axis."""

FLOAT, UINT8, INT64, BOOL = 1, 2, 7, 9
"""ONNX's codes of element types."""


def main() -> None:
    """Write a file."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--candidates", type=Path, metavar="FILE")
    path = parser.parse_args().candidates
    model = candidates_model() if path else points_model()
    (path or POINTS_GRAPH).write_bytes(model.SerializeToString())


def points_model() -> onnx.ModelProto:
    """Make the graph that maps images to their best points; an initializer holds their number."""
    graph = Graph(PREFIX)
    count = graph.constant([2048], MAX_KEYPOINTS)
    gray = graph.named(gray_of(Tensor(graph, "image")), GRAY)
    limit = (count * CANDIDATES_PER_KEYPOINT).Max([MIN_CANDIDATES])
    levels = scale_space(gray)
    x, y, scores, sizes, level = choose(*rank_candidates(levels, limit), count)
    xy = graph.join([x.Unsqueeze([2]), y.Unsqueeze([2])], axis=2)
    angles = scores.Greater(0.0).Where(directions(levels, x, y, level), 0.0)
    found = scores.Greater(0.0)
    tensors = xy, scores, sizes, angles, described(graph, gray, xy, sizes, angles, found)
    shapes = [["batch", "count", *last] for last in ([2], [], [], [], [LENGTH])]
    names = *POINTS, DESCRIPTORS
    outputs = [(name, FLOAT, shape) for name, shape in zip(names, shapes, strict=True)]
    inputs = ("image", FLOAT, ["batch", 3, "height", "width"]), (UPRIGHT, FLOAT, shapes[-1])
    return graph.model(inputs, outputs, tensors)


def described(graph: Graph, gray: Tensor, xy: Any, sizes: Any, angles: Any, found: Any) -> Any:
    """Name the inputs of a descriptor's network; return its descriptors rotated by the angles.

    The luma is padded as in `describe_batch`, and descriptors are rotated as by `turn_descriptors`.
    """
    graph.prefix = DESCRIBING
    height, width = (gray.Shape(start=axis, end=axis + 1) for axis in (2, 3))
    luma, ends = gray / 255.0, (height, width)
    for axis, side in zip((2, 3), ends, strict=True):
        period = (side * 2 - 2).Max([1])
        last = ((side + (STRIDE - 1)) / STRIDE * STRIDE).Squeeze()
        places = graph.add("Range", 0, last, 1).Mod(period)
        luma = luma.Gather(places.Min(period - places), axis=axis)
    for tensor, name in ((luma, "luma"), (xy, "xy"), (sizes.Max(1.0), "sizes")):
        graph.named(tensor, DESCRIBING + name)
    turns = (angles * (-np.pi / 180)).Unsqueeze([2]) * (FREQUENCIES * 1.0)
    cosine, sine = turns.Cos(), turns.Sin()
    upright, middle = Tensor(graph, UPRIGHT), CONSTANT + len(FREQUENCIES)
    parts = (0, CONSTANT), (CONSTANT, middle), (middle, LENGTH)
    constant, real, imaginary = (upright.Slice([start], [end], [2]) for start, end in parts)
    turned = real * cosine - imaginary * sine, real * sine + imaginary * cosine
    return found.Unsqueeze([2]).Where(graph.join([constant, *turned], axis=2), 0.0)


def candidates_model() -> onnx.ModelProto:
    """Make the graph that maps grey images and a number `limit` to at most `limit` candidates."""
    graph = Graph(PREFIX)
    gray, limit = Tensor(graph, "gray").Cast(to=FLOAT), Tensor(graph, "limit")
    x, y, level, logits = rank_candidates(scale_space(gray), limit)
    tensors = x, y, graph.tensor(SIGMAS_PX).Gather(level), logits
    outputs = [(name, FLOAT, ["batch", "count"]) for name in ("x", "y", "sigmas", "logits")]
    inputs = ("gray", UINT8, ["batch", 1, "height", "width"]), ("limit", INT64, [1])
    return graph.model(inputs, outputs, tensors)


def _operator(kind: str) -> Callable[[Tensor, Any], Any]:
    return lambda tensor, other: tensor.graph.add(kind, tensor, other)


class Tensor:
    """A tensor of a graph: `tensor.Kind(...)` and Python's operators add nodes that read it."""

    def __init__(self, graph: Graph, name: str) -> None:
        self.graph, self.name = graph, name

    def __getattr__(self, kind: str) -> Any:
        return lambda *inputs, **values: self.graph.add(kind, self, *inputs, **values)

    __add__, __sub__, __mul__, __truediv__ = map(_operator, ("Add", "Sub", "Mul", "Div"))


class Graph:
    """Nodes and constants of a model or a loop body; their names start with the prefix."""

    def __init__(self, prefix: str) -> None:
        self.prefix, self.nodes = prefix, []
        self.made: dict[tuple[Any, ...], list[Tensor]] = {}
        self.constants: dict[Any, onnx.TensorProto] = {}

    def constant(self, value: Any, name: str | None = None) -> Tensor:
        """Return a constant of float32, int64 or bool; equal unnamed constants are shared."""
        array = np.asarray(value)
        array = array.astype({"f": np.float32, "b": np.bool_}.get(array.dtype.kind, np.int64))
        key = name or (array.dtype, array.shape, array.tobytes())
        if key not in self.constants:
            name = name or f"{self.prefix}constant{len(self.constants)}"
            self.constants[key] = numpy_helper.from_array(array, name)
        return Tensor(self, self.constants[key].name)

    def tensor(self, value: Any) -> Tensor:
        """Return a tensor of this graph: a constant, or a tensor of the enclosing graph."""
        return Tensor(self, value.name) if isinstance(value, Tensor) else self.constant(value)

    def add(self, kind: str, *inputs: Any, outputs: int = 1, **values: Any) -> Any:
        """Add a node, unless an equal one exists; return its output, or a list of its outputs."""
        read = [self.tensor(value).name for value in inputs]
        key = kind, *read, repr(values)
        if key not in self.made:
            names = [f"{self.prefix}{kind}{len(self.nodes)}.{k}" for k in range(outputs)]
            self.nodes.append(helper.make_node(kind, read, names, **values))
            self.made[key] = [Tensor(self, name) for name in names]
        return self.made[key] if outputs > 1 else self.made[key][0]

    def named(self, tensor: Tensor, name: str) -> Tensor:
        """Return a copy of a tensor under a name of its own."""
        self.nodes.append(helper.make_node("Identity", [tensor.name], [name]))
        return Tensor(self, name)

    def join(self, inputs: Sequence[Any], axis: int) -> Any:
        """Concatenate tensors."""
        return self.add("Concat", *inputs, axis=axis)

    def loop(self, count: Any, step: Callable[..., Sequence[Any]], *state: Any) -> list[Any]:
        """Repeat a step; return its last state and the stacked results of all steps.

        `step` is called with tensors of the body's graph: the index of the step, whether the loop
        continues, and the int64 state. It returns whether the loop continues, the new state, and
        float32 results.
        """
        body = Graph(f"{self.prefix}loop{len(self.nodes)}/")
        given = [Tensor(body, f"{body.prefix}given{k}") for k in range(2 + len(state))]
        results = step(*given)
        kinds = [(INT64, ()), (BOOL, ()), *[(INT64, None)] * len(state)]
        inputs = [
            helper.make_tensor_value_info(each.name, *kind)
            for each, kind in zip(given, kinds, strict=True)
        ]
        outputs = [helper.make_empty_tensor_value_info(each.name) for each in results]
        graph = helper.make_graph(body.nodes, "step", inputs, outputs, [*body.constants.values()])
        return self.add("Loop", count, True, *state, outputs=len(results) - 1, body=graph)

    def model(
        self,
        inputs: Sequence[tuple[Any, ...]],
        outputs: Sequence[tuple[Any, ...]],
        tensors: Sequence[Tensor],
    ) -> onnx.ModelProto:
        """Return the model; inputs and outputs are given by name, type and shape."""
        for output, tensor in zip(outputs, tensors, strict=True):
            self.named(tensor, output[0])
        ends = [[helper.make_tensor_value_info(*one) for one in end] for end in (inputs, outputs)]
        constants = [*self.constants.values()]
        graph = helper.make_graph(self.nodes, "points", *ends, constants)
        opsets = [helper.make_opsetid("", OPSET)]
        return helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION)


def gray_of(image: Any) -> Any:
    """Convert (B, 3, H, W) RGB in [0, 1] to (B, 1, H, W) grey levels, equal to OpenCV's."""
    gray = ((image * 255.0).Round() * np.reshape(LUMA, (1, 3, 1, 1))).ReduceSum([1])
    return ((gray + LUMA_UNIT / 2) / LUMA_UNIT).Floor()


class Levels(NamedTuple):
    """Scale space of images.

    `mean` is the images' mean grey level, (B, 1, 1, 1). `flat` holds all levels of an image in one
    row. Each level is padded by `MARGIN`, mirrored at its outermost rows and columns, as in the
    filters. `starts`, `heights` and `widths` are (L,): each level's first index in `flat`, and its
    sides without padding. `frames` are the padded levels as images.
    """

    mean: Any
    flat: Any
    starts: Any
    heights: Any
    widths: Any
    frames: list[Any]

    def at(self, graph: Graph) -> Levels:
        """Return the same tensors in the graph of a loop body."""
        return Levels(*(graph.tensor(each) for each in self[:-1]), [])

    def places(self, level: Any, row: Any, column: Any) -> tuple[Any, Any]:
        """Return the indices of pixels in `flat`, and the distances in `flat` between rows."""
        stride = self.widths.Gather(level) + 2 * MARGIN
        return self.starts.Gather(level) + stride * (row + MARGIN) + (column + MARGIN), stride


def scale_space(gray: Any) -> Levels:
    """Return the scale space of (B, 1, H, W) grey images, as `build_scale_space` computes it."""
    graph, octave, reached, frames, sides = gray.graph, 0, 0.0, [], []
    mean = gray.ReduceMean(axes=[1, 2, 3]).Round()
    smooth = (gray - mean) / 255.0
    for k, sigma in enumerate(SIGMAS_PX):
        height, width = (smooth.Shape(start=axis, end=axis + 1) for axis in (2, 3))
        if OCTAVES[k] > octave:
            # After slices with steps up to `END`, OpenVINO 2026.4 confuses sides (request 37932).
            smooth = smooth.Slice([0], height, [2], [2]).Slice([0], width, [3], [2])
            height, width = (smooth.Shape(start=axis, end=axis + 1) for axis in (2, 3))
            octave = OCTAVES[k]
        # The variances of Gaussians add up, so each level smooths the previous one.
        smooth = _blur(smooth, np.sqrt(sigma**2 - reached**2) / 2.0**octave, height, width)
        frames.append(_framed(_framed(smooth, MARGIN, 2, height), MARGIN, 3, width))
        sides.append((height, width))
        reached = sigma
    heights, widths = (graph.join(each, axis=0) for each in zip(*sides, strict=True))
    areas = (heights + 2 * MARGIN) * (widths + 2 * MARGIN)
    flat = graph.join([each.Flatten() for each in frames], axis=1)
    return Levels(mean, flat, areas.CumSum(0, exclusive=1), heights, widths, frames)


def rank_candidates(levels: Levels, limit: Any) -> tuple[Any, Any, Any, Any]:
    """Find the strongest candidates in scale spaces, at most `limit`, and rank them.

    Returns:
        x, y, level and logit, (B, K) each, the strongest first. The candidates of an image are
        followed by at least one padding entry, whose logit is -infinity.
    """
    graph = levels.flat.graph
    strength = graph.join([_peaks(levels, k) for k in range(FIRST, LAST + 1)], axis=1)
    count = strength.Greater(0.0).Cast(to=FLOAT).ReduceSum([1], keepdims=0)
    count = count.ReduceMax(axes=[0]).Cast(to=INT64)
    count = count.Min(limit).Max([1])
    missing = count.Mod(CHUNK) * -1 + CHUNK
    padding = graph.join([[0, 0, 0], missing], axis=0)
    strength, place = (each.Pad(padding) for each in strength.TopK(count, axis=1, outputs=2))
    ends = (levels.heights * levels.widths).Slice([FIRST], [LAST + 1]).CumSum(0)
    level = place.Unsqueeze([2]).Less(ends).Cast(to=INT64).ReduceSum([2], keepdims=0)
    level = level * -1 + (LAST + 1)
    before = graph.join([[0], ends], axis=0).Gather(level - FIRST)
    width = levels.widths.Gather(level)
    pixels = level, (place - before) / width, (place - before).Mod(width)

    def measure(number: Any, going: Any) -> tuple[Any, ...]:
        start = number.Reshape([1]) * CHUNK
        own = (
            number.graph.tensor(each).Slice(start, start + CHUNK, [1]).Unsqueeze([1])
            for each in pixels
        )
        ranks = start + np.arange(1, CHUNK + 1)
        return going.Identity(), *_measure(levels.at(number.graph), *own, ranks)

    x, y, logits = (
        each.Transpose(perm=[1, 0, 2]).Reshape([0, -1])
        for each in graph.loop(((count + missing) / CHUNK).Squeeze(), measure)
    )
    return x, y, level, strength.Greater(0.0).Where(logits, -np.inf)


def _peaks(levels: Levels, k: int) -> Any:
    """Return the (B, H W) strengths of a level's maxima, 0 elsewhere."""
    graph, frame, inner = levels.flat.graph, levels.frames[k], []
    for sides in (levels.heights, levels.widths):
        side = sides.Slice([k], [k + 1])
        place = graph.add("Range", 0, side.Squeeze(), 1)
        inner.append(place.Greater(0).And(place.Less(side - 1)))
    inside = inner[0].Unsqueeze([1]).And(inner[1])
    response = _determinant(frame, MARGIN, VARIANCES[k]).Abs()
    radius = int(NMS_RADII[k])
    window = {"kernel_shape": [2 * radius + 1] * 2, "pads": [radius] * 4}
    peak = response.Equal(response.MaxPool(**window)).And(inside)
    return peak.And(response.Greater(LEAST_RESPONSE)).Where(response, 0.0).Flatten()


def _framed(values: Any, radius: int, axis: int, side: Any, more: Any = 0) -> Any:
    """Pad images by `radius` mirrored rows (axis 2) or columns (axis 3); at the end add `more`."""
    graph, period = values.graph, (side * 2 - 2).Max([1])
    ends = (-radius, 0), (side.Squeeze(), (side + radius + more).Squeeze())
    places = (graph.add("Range", *end, 1).Mod(period) for end in ends)
    before, after = (values.Gather(each.Min(period - each), axis=axis) for each in places)
    return graph.join([before, values, after], axis=axis)  # copies `values` in long rows


def _blur(values: Any, sigma: float, height: Any, width: Any) -> Any:
    """Smooth images as `cv2.GaussianBlur` does.

    Convolutions with one channel are slow, so `TOGETHER` neighbours become channels. Transposed
    convolutions are used, because OpenVINO would round others to bfloat16.
    """
    graph, radius = values.graph, round(2 * REACH_PER_SIGMA * sigma + 1) // 2
    kernel = cv2.getGaussianKernel(2 * radius + 1, float(sigma), cv2.CV_32F)[:, 0]
    # The neighbours of a block of pixels lie in this block and the next `more`.
    more = (2 * radius + TOGETHER - 1) // TOGETHER
    numbers = np.arange(TOGETHER)
    within = graph.constant(numbers[:, None, None] - numbers[:, None] + TOGETHER - 1)
    beyond = TOGETHER * (more + 2) - 1 - len(kernel)
    table = graph.constant(np.pad(kernel, (TOGETHER - 1, beyond)))  # takes little space
    weights = table.Gather(within + TOGETHER * np.arange(more, -1, -1))
    for axis, side in ((3, width), (2, height)):
        missing = (side * -1).Mod([TOGETHER]) + (TOGETHER * more - 2 * radius)
        blocks = _framed(values, radius, axis, side, missing)
        # The side is divided into blocks, (B, TOGETHER, H, W), smoothed, and joined again.
        if axis == 3:
            blocks = blocks.Squeeze([1]).Reshape([0, 0, -1, TOGETHER]).Transpose(perm=[0, 3, 1, 2])
            shape, crop, order, whole = (1, -1), [0, more], [0, 2, 3, 1], [0, 0, -1]
        else:
            blocks = blocks.Reshape(graph.join([[0, -1, TOGETHER], width], axis=0))
            blocks = blocks.Transpose(perm=[0, 2, 1, 3])
            shape, crop, order = (-1, 1), [more, 0], [0, 2, 1, 3]
            whole = graph.join([[0, -1], width], axis=0)
        kernels = weights.Reshape([TOGETHER, TOGETHER, *shape])
        smooth = blocks.ConvTranspose(kernels, pads=crop * 2).Transpose(perm=order)
        values = smooth.Reshape(whole).Unsqueeze([1]).Slice([0], side, [axis])
    return values


def _measure(levels: Levels, level: Any, row: Any, column: Any, ranks: Any) -> tuple[Any, Any, Any]:
    """Return x, y and logits of candidates, as `describe_candidates` and the ranker compute them.

    Candidates are the last axis of all tensors, so that slices along other axes copy long rows.
    """
    graph, variances = level.graph, level.graph.tensor(VARIANCES)
    pixel = graph.tensor(1 << OCTAVES)

    def look(level: Any, row: Any, column: Any, reach: int) -> Any:
        """Return the smoothed image within `reach` pixels, (B, N, side, side, K)."""
        steps, places = np.arange(-reach, reach + 1), levels.places(level, row, column)
        place, stride = (each.Unsqueeze([2, 3]) for each in places)
        place = place + stride * steps[:, None, None] + steps[:, None]
        values = levels.flat.GatherElements(place.Reshape([0, -1]), axis=1)
        count = row.Shape(start=1, end=2)
        shape = graph.join([[0], count, [len(steps), len(steps), -1]], axis=0)
        return values.Reshape(shape)

    # Windows around each candidate's nearest pixel in its own level and others, (B, 4, 7, 7, K).
    near = level + NEAR[:, None]
    factor, other = pixel.Gather(level), pixel.Gather(near)
    down, right = (
        ((each * factor + other / 2) / other).Min(sides.Gather(near) - 1)
        for each, sides in ((row, levels.heights), (column, levels.widths))
    )
    values = look(near, down, right, MARGIN)
    scale = variances.Gather(near).Unsqueeze([2, 3])
    windows = _determinant(values, 1, scale).Abs()
    highest = _log(windows.ReduceMax(axes=[2, 3], keepdims=0)).Gather(OTHERS, axis=1)
    determinant, light, slope = (
        _determinant(values, MARGIN, scale).Squeeze([2, 3]),
        _at(values, MARGIN, 0, 0).Squeeze([2, 3]),
        _log_slope(values, MARGIN, scale).Squeeze([2, 3]),
    )
    xx, yy = _bends(values, MARGIN)
    own_determinant, own_light = (each.Slice([1], [2], [1]) for each in (determinant, light))
    strength = (own_determinant.Abs() + STRENGTH_FLOOR).Sqrt()
    trace = (((xx + yy) * scale).Squeeze([2, 3]) / strength / 2.0).Atan()
    own, others = _log(own_determinant), _log(determinant).Gather(OTHERS, axis=1)

    # Rings around each candidate in its own level, (B, 32, 3, 3, K).
    right, below = (
        (
            graph.tensor(table)
            .Gather(level * 2 + each.Mod(2))
            .Squeeze([1])
            .Transpose(perm=[0, 2, 1])
            + each
        )
        .Max(0)
        .Min(last)
        for each, table, last in (
            (column, np.concatenate(ring_offsets()[0]), levels.widths.Gather(level) - 1),
            (row, np.concatenate(ring_offsets()[1]), levels.heights.Gather(level) - 1),
        )
    )
    values = look(level, below, right, 1)
    scale = variances.Gather(level).Unsqueeze([2, 3])
    responses, slopes, lights = (
        each.Reshape([0, RING_POINTS, len(RING_RADII), -1])
        for each in (
            _log(_determinant(values, 1, scale)),
            _log_slope(values, 1, scale),
            (_at(values, 1, 0, 0) - own_light.Unsqueeze([2, 3])) / strength.Unsqueeze([2, 3]),
        )
    )

    def over(ring: Any, kind: str) -> Any:
        return getattr(ring, f"Reduce{kind}")(axes=[1], keepdims=0)

    ring = 21 + 8 * np.arange(len(RING_RADII))
    area = (levels.heights * levels.widths).Slice([0], [1])
    features = {  # keys: columns of the ranker's input
        (0,): (own + 9.0) / 3.0,
        (1, 2, 3): (others - own) / 2.0,
        (4,): own_determinant.Sign(),
        (5, 7, 9, 11): trace,
        (6, 8, 10, 12): trace.Abs(),
        (13, 14, 15, 16): (slope - own) / 4.0,
        (17,): (own_light + levels.mean.Squeeze([3]) / 255.0) * 2.0 - 1.0,
        (18, 19, 20): (highest - others) / 2.0,
        (*ring,): (over(responses, "Mean") - own) / 2.0,
        (*ring + 1,): (over(responses, "Max") - own) / 2.0,
        (*ring + 2,): (over(responses, "Min") - own) / 4.0,
        (*ring + 3,): (over(lights, "Mean") / 2.0).Atan(),
        (*ring + 4,): (over(lights, "Max") / 2.0).Atan(),
        (*ring + 5,): (over(lights, "Min") / 2.0).Atan(),
        (*ring + 6,): (over(slopes, "Mean") - own) / 4.0,
        (*ring + 7,): (over(slopes, "Max") - own) / 4.0,
        (53,): own * 0.0 + (ranks.Cast(to=FLOAT) / area.Cast(to=FLOAT)).Log() / 2.0 + 3.0,
        (54,): (level - 4).Cast(to=FLOAT) / 3.0,
    }
    response = windows.Slice([1], [2], [1])
    x, y = (
        ((each.Cast(to=FLOAT) + offset.Squeeze([2, 3])) * factor.Cast(to=FLOAT)).Squeeze([1])
        for each, offset in zip((column, row), _peak_offsets(response), strict=True)
    )
    return x, y, _rank(graph, features)


def _at(values: Any, margin: int, down: int, right: int) -> Any:
    """Return the neighbours at (down, right) of pixels that are not in the margins (axes 2, 3)."""
    start, stop = np.add(margin, (down, right)), np.subtract((down, right), margin)
    return values.Slice(start, np.where(stop, stop, END), [2, 3])


def _bends(values: Any, margin: int) -> tuple[Any, Any]:
    """Return the second differences in x and in y of all pixels that are not in the margins."""
    double = _at(values, margin, 0, 0) * 2.0
    xx = (_at(values, margin, 0, -1) - double) + _at(values, margin, 0, 1)
    yy = (_at(values, margin, -1, 0) - double) + _at(values, margin, 1, 0)
    return xx, yy


def _determinant(values: Any, margin: int, variance: Any) -> Any:
    """Return the determinant of the Hessian, by the same operations as `kernels.differentiate`."""
    xx, yy = _bends(values, margin)
    below = _at(values, margin, 1, 1) - _at(values, margin, 1, -1)
    xy = below - (_at(values, margin, -1, 1) - _at(values, margin, -1, -1))
    variance = values.graph.tensor(variance)
    return (xx * yy - xy * xy * (1 / 16)) * (variance * variance)


def _log(determinant: Any) -> Any:
    return (determinant.Abs() + DETERMINANT_FLOOR).Log()


def _log_slope(values: Any, margin: int, variance: Any) -> Any:
    """Return the logarithm of the squared gradient, normalised by the level's variance."""
    dx = _at(values, margin, 0, 1) - _at(values, margin, 0, -1)
    dy = _at(values, margin, 1, 0) - _at(values, margin, -1, 0)
    return ((dx * dx + dy * dy) * (variance * 0.25) + GRADIENT_FLOOR).Log()


def _peak_offsets(response: Any) -> list[Any]:
    """Return the offsets in x and y of maxima from window centres, as `refine_peaks` does."""
    near = [[_at(response, MARGIN - 1, j, i) for i in (-1, 0, 1)] for j in (-1, 0, 1)]
    dx, dy = (near[1][2] - near[1][0]) * 0.5, (near[2][1] - near[0][1]) * 0.5
    xx = (near[1][0] - near[1][1]) + (near[1][2] - near[1][1])
    yy = (near[0][1] - near[1][1]) + (near[2][1] - near[1][1])
    mixed = ((near[0][0] - near[0][2]) + (near[2][2] - near[2][0])) * 0.25
    bend = xx * yy - mixed * mixed
    mixed = bend.Greater(0.0).And(xx.Less(0.0)).Where(mixed, 0.0)
    bend = xx * yy - mixed * mixed
    offsets = (mixed * dy - yy * dx) / bend, (mixed * dx - xx * dy) / bend
    return [
        bend.Greater(0.0).Where(each.Clip(-MAX_OFFSET_PX, MAX_OFFSET_PX), 0.0) for each in offsets
    ]


def _rank(graph: Graph, features: dict[tuple[int, ...], Any]) -> Any:
    """Return the (B, K) logits of features, as `Ranker.rank` does."""
    ranker, order = load_ranker(), np.concatenate([*map(np.array, features)])
    values = graph.join([*features.values()], axis=1)
    values = (values - ranker.mean[order, None]) / ranker.deviation[order, None]
    values = values.Clip(-MAX_DEVIATIONS, MAX_DEVIATIONS)
    for k, (weight, bias) in enumerate(ranker.layers):
        values = values.Relu() if k else values
        # This is a matrix product, but OpenVINO would round the inputs of MatMul to bfloat16.
        weight = (weight if k else weight[:, order]).T[:, :, None]
        values = values.ConvTranspose(weight) + bias[:, None]
    return (values + features[0,]).Squeeze([1])


def choose(x: Any, y: Any, level: Any, logits: Any, count: Any) -> list[Any]:
    """Keep candidates that are not near a better candidate that is kept.

    Returns x, y, scores, sizes and levels of the `count` best kept ones, (B, `count`) each.
    """
    graph = x.graph
    logits, order = logits.TopK(logits.Shape(start=1), axis=1, outputs=2)
    valid = logits.Greater(-np.finfo(np.float32).max)
    level = level.GatherElements(order, axis=1)
    tail = (logits.Abs() + 1.0).Reciprocal() * 0.5
    x, y, scores, sizes, radii, level = (
        valid.Where(each, nothing)
        for each, nothing in (
            (x.GatherElements(order, axis=1), -1.0),
            (y.GatherElements(order, axis=1), -1.0),
            (logits.Less(0.0).Where(tail, tail * -1.0 + 1.0), 0.0),
            (graph.tensor(SIZE_PER_SIGMA * SIGMAS_PX).Gather(level), 0.0),
            (graph.tensor(least_distances(SIGMAS_PX)).Gather(level), 0.0),
            (level, FIRST),
        )
    )
    last = x.Shape(start=1) - 1

    def suppress(number: Any, _: Any, rows: Any, found: Any) -> tuple[Any, Any, Any]:
        """Add the candidates of a block without better neighbours, as `suppress_neighbors` does."""
        start, numbers = number.Reshape([1]) * BLOCK, np.arange(BLOCK)
        places = [number.graph.tensor(each) for each in (x, y, radii)]
        here = [each.Slice(start, start + BLOCK, [1]) for each in places]
        known = rows.Slice([0], found.ReduceMax(keepdims=0).Reshape([1]) + 1, [1])
        there = [each.GatherElements(known, axis=1) for each in places]
        free = _near(here, there).ReduceMax(axes=[2], keepdims=1).Less(0.5)
        free = free.And(here[2].Greater(0.0).Unsqueeze([2])).Cast(to=FLOAT)
        better = number.graph.tensor(numbers).Less(numbers[:, None]).Cast(to=FLOAT)
        better = better * _near(here, here)

        def settle(_: Any, __: Any, kept: Any) -> tuple[Any, Any]:
            """Keep points whose better neighbours are all suppressed, until nothing changes."""
            first, near = (kept.graph.tensor(each) for each in (free, better))
            settled = near.MatMul(kept.Cast(to=FLOAT)).Greater(0.0).Where(0.0, first)
            settled = settled.Cast(to=INT64)
            return (settled - kept).Abs().ReduceMax(keepdims=0).Cast(to=BOOL), settled

        kept = number.graph.loop(BLOCK, settle, free.Cast(to=INT64)).Squeeze([2])
        slots, is_kept = (kept.CumSum(1) + found - 1).Min(count), kept.Cast(to=BOOL)
        rows = rows.ScatterElements(
            is_kept.Where(slots, count), is_kept.Where(start + numbers, last), axis=1
        )
        found = (found + kept.ReduceSum([1])).Min(count)
        return found.Less(count).Cast(to=FLOAT).ReduceMax(keepdims=0).Cast(to=BOOL), rows, found

    # Indices of the kept candidates, filled up with the last index (padding), and their number.
    images = x.Shape(end=1)
    rows = last.Expand(graph.join([images, count + 1], axis=0))
    found = graph.tensor([[0]]).Expand(graph.join([images, [1]], axis=0))
    rows, _ = graph.loop(((last + 1) / BLOCK).Squeeze(), suppress, rows, found)
    rows = rows.Slice([0], count, [1])
    return [each.GatherElements(rows, axis=1) for each in (x, y, scores, sizes, level)]


def directions(levels: Levels, x: Any, y: Any, level: Any) -> Any:
    """Return the dominant orientations of points, (B, K) degrees, as `candidate_angles` does."""
    graph, count = x.graph, x.Shape(start=1)
    padding = graph.join([[0, 0, 0], count.Mod(BLOCK) * -1 + BLOCK], axis=0)
    x, y = (each.Pad(padding) for each in (x, y))
    level = level.Pad(padding, FIRST)

    def turn(number: Any, going: Any) -> tuple[Any, Any]:
        start = number.Reshape([1]) * BLOCK
        own = (
            number.graph.tensor(each).Slice(start, start + BLOCK, [1]).Unsqueeze([1, 2, 3])
            for each in (x, y, level)
        )
        return going.Identity(), _turn(levels.at(number.graph), *own)

    blocks = (x.Shape(start=1) / BLOCK).Squeeze()
    angles = graph.loop(blocks, turn).Transpose(perm=[1, 0, 2]).Reshape([0, -1])
    return angles.Slice([0], count, [1])


def _turn(levels: Levels, x: Any, y: Any, level: Any) -> Any:
    """Return the orientations (B, K) of points, (B, 1, 1, 1, K), as `strongest_directions` does."""
    coarser = np.clip(np.arange(1, len(OCTAVES) + 1), 0, len(OCTAVES) - 1)
    pixel, step = 2 ** ANGLE_OCTAVES[coarser], 2 ** (ANGLE_OCTAVES - OCTAVES)[coarser]
    windows = (WINDOW_PER_LEVEL * SIGMAS_PX / pixel).astype(np.float32)
    most = int(np.rint(RADIUS_PER_WINDOW * windows[FIRST : LAST + 1]).max())
    graph, reach = level.graph, np.arange(-most - 1, most + 2)
    scale, window, step = (
        graph.tensor(each).Gather(level) for each in (pixel * 1.0, windows, step)
    )
    level, radius = level + 1, (window * float(RADIUS_PER_WINDOW)).Round()
    place, weight = levels.places(level, 0, 0)[0], graph.tensor(1.0)
    strides = levels.widths.Gather(level) + 2 * MARGIN, 1
    for value, sides, axis, stride in zip(
        (y, x), (levels.heights, levels.widths), (0, 1), strides, strict=True
    ):
        middle = (value / scale).Round().Cast(to=INT64)
        side = (sides.Gather(level) + step - 1) / step
        steps = reach.reshape((-1, 1, 1) if axis == 0 else (-1, 1))
        where = middle + steps
        place = place + where.Max(0).Min(side - 1) * step * stride
        # The outermost pixels have no gradient.
        near = graph.tensor(np.abs(steps) * 1.0).LessOrEqual(radius)
        near = near.And(where.Greater(0)).And(where.Less(side - 1))
        weight = weight * near.Where(
            ((graph.tensor(steps * 1.0) / window).Pow(2.0) * -0.5).Exp(), 0.0
        )
    values = levels.flat.GatherElements(place.Reshape([0, -1]), axis=1)
    values = values.Reshape([0, 1, len(reach), len(reach), -1])
    dx = _at(values, 1, 0, 1) - _at(values, 1, 0, -1)
    dy = _at(values, 1, 1, 0) - _at(values, 1, -1, 0)
    across, down = dx.Abs(), dy.Abs()
    part = across.Min(down) / (across.Max(down) + float(np.finfo(float).eps))
    square, angle = part * part, 0.0
    for factor in ATAN[::-1]:
        angle = graph.tensor(angle) * square + float(factor)
    angle = angle * part
    angle = across.Less(down).Where(angle * -1.0 + 90.0, angle)
    angle = dx.Less(0.0).Where(angle * -1.0 + 180.0, angle)
    angle = dy.Less(0.0).Where(angle * -1.0 + 360.0, angle)
    vote = _at(weight, 1, 0, 0) * (dx * dx + dy * dy).Sqrt()
    bins = (angle * (BINS / 360)).Round().Cast(to=INT64).Mod(BINS)
    shape, numbers = [0, (len(reach) - 2) ** 2, -1], np.arange(BINS)
    bins, vote = (each.Reshape(shape) for each in (bins, vote))
    votes = vote.Slice([0], [BINS], [1]) * 0.0
    votes = votes.ScatterElements(bins, vote, axis=1, reduction="add")
    near, far = (
        votes.Gather((numbers - k) % BINS, axis=1) + votes.Gather((numbers + k) % BINS, axis=1)
        for k in (1, 2)
    )
    smooth = (votes * 6.0 + near * 4.0 + far) / 16.0
    best = smooth.ArgMax(axis=1)
    before, middle, after = (
        smooth.GatherElements((best + BINS + k).Mod(BINS), axis=1) for k in (-1, 0, 1)
    )
    bend = before - middle * 2.0 + after
    shift = bend.Less(0.0).Where((before - after) / (bend * 2.0), 0.0)
    degrees = (best.Cast(to=FLOAT) + shift) * (360 / BINS)
    degrees = degrees.Less(0.0).Where(degrees + 360.0, degrees)
    return degrees.Less(360.0).Where(degrees, 0.0).Squeeze([1])


def _near(one: list[Any], other: list[Any]) -> Any:
    """Return (B, K, L): 1 where the first points are near the second ones, otherwise 0."""
    x, y, radius = ((a.Unsqueeze([2]), b.Unsqueeze([1])) for a, b in zip(one, other, strict=True))
    dx, dy, least = x[0] - x[1], y[0] - y[1], radius[0].Min(radius[1])
    return (dx * dx + dy * dy).Less(least * least).Cast(to=FLOAT)


if __name__ == "__main__":
    main()
