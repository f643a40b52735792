"""The detector: an image in, a heat map or keypoints out."""

from __future__ import annotations

import copy
import functools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol, overload

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.options import suggest_keywords
from ..features.keypoints import Keypoints
from ..features.maps import Maps
from ..features.selection import SelectionOptions, select_from_maps, select_keypoints
from ..io.image import load_image
from .backends import RuntimeOptions, open_network
from .heatmap import (
    HeatmapOptions,
    compute_heatmap_and_logits,
    compute_maps,
    compute_maps_of_batch,
    seen_size,
)
from .image_lists import (
    Images,
    batches,
    check_batch_size,
    ignore_masks,
    image_list,
    image_named,
)
from .image_points import find_points, memory_named
from .pretrained import RANKER, resolve_weights

CHANNELS_OF_IMAGES = (
    "give it with each image, as detect(image, channels='bgr'); what the network itself is fed is "
    "`network_channels`"
)


class HeatmapDetector(Protocol):
    """What matching and reconstruction ask of a detector."""

    def heatmap(self, image: Any) -> np.ndarray:
        """Map an image to a (H, W) float32 probability of a keypoint."""
        ...


class DeepDetect:
    """The dense keypoint detector of the paper.

    Args:
        weights: "default", "dense" or "free", the weights inside the package; or an ONNX file, or
            a safetensors file where torch is installed.
        resolution: "auto" (the image as it is up to two megapixels, larger ones scaled down to
            that), "native" (always as it is), or a number of pixels: the image is squashed to a
            square of that side, as the paper does with 480.
        backend: "auto" (OpenVINO when it is installed, else ONNX Runtime; torch for
            safetensors), "onnxruntime", "openvino" or "torch".
        device: "cpu"; or, with ONNX Runtime, "cuda", or the name of an execution provider, as
            "TensorrtExecutionProvider".
        threads: number of threads. None: the backend's choice.
        precision: what the network computes with, "float32", or "bfloat16" with OpenVINO: faster on
            processors with instructions for it; a few keypoints are others, and there are no tiles.
        network_channels: "rgb", or "bgr" as the paper's published code feeds the network. For
            images of OpenCV leave it, and give the methods `channels="bgr"`.
        tta: "flip": a flipped or turned image gives the same keypoints of the heat map, in eight
            times the time.
        tile_megapixels: with `resolution="native"`, images above so many megapixels are run in
            tiles of this size, which takes
            less memory and four to six times the time. "auto": where the memory is too small.
        ranker: npz file of `deepdetect train-points` that ranks points. None: the one inside the
            package.

    Attributes:
        backend: name of the backend that runs.
        heatmap_options: how images are shown to the network.

    Raises:
        WeightsError: the weights or the ranker are missing, damaged or do not fit.
        OptionError: an option is unknown or out of its range.
        MissingExtraError: the backend is not installed.

    Example:
        >>> import numpy as np
        >>> image = np.zeros((48, 64), np.uint8)
        >>> image[16:32, 16:48] = 255
        >>> detector = DeepDetect()
        >>> detector.heatmap(image).shape
        (48, 64)
        >>> len(detector.detect(image, max_keypoints=10))
        10
    """

    @functools.partial(suggest_keywords, elsewhere={"channels": CHANNELS_OF_IMAGES})
    def __init__(
        self,
        weights: str | Path = "default",
        *,
        resolution: Literal["auto", "native"] | int = "auto",
        backend: str = "auto",
        device: str = "cpu",
        threads: int | None = None,
        precision: Literal["float32", "bfloat16"] = "float32",
        network_channels: Channels = "rgb",
        tta: Literal["none", "flip"] = "none",
        tile_megapixels: float | Literal["auto"] = "auto",
        ranker: str | Path | None = None,
    ) -> None:
        self.weights = resolve_weights(weights)
        self.heatmap_options = HeatmapOptions(resolution, network_channels, tta, tile_megapixels)
        self.ranker = RANKER if ranker is None else Path(ranker)
        if ranker is not None:  # what may be wrong with it is said now
            from .points.ranker import load_ranker

            load_ranker(self.ranker)
        self._runtime = RuntimeOptions(backend, device, threads, precision)
        self._network, self.backend = open_network(self.weights, self._runtime)

    @property
    def runtime(self) -> str:
        """What runs the network, as "openvino" or "openvino, bfloat16": results depend on it."""
        precision = self._runtime.precision
        return self.backend if precision == "float32" else f"{self.backend}, {precision}"

    @suggest_keywords
    def configured(self, heatmap_options: HeatmapOptions) -> DeepDetect:
        """Return a detector with the same loaded network and other heat map options."""
        other = copy.copy(self)
        other.heatmap_options = heatmap_options
        return other

    @suggest_keywords
    def with_weights(self, weights: str | Path) -> DeepDetect:
        """Return a detector with other weights, and all other options as they are.

        Raises:
            WeightsError: the weights are missing, damaged or do not fit.
        """
        other = self.configured(self.heatmap_options)
        other.weights = resolve_weights(weights)
        other._network, other.backend = open_network(other.weights, self._runtime)
        return other

    @overload
    def heatmap(
        self, image: Images, *, channels: Channels = ..., batch_size: int = ...
    ) -> list[np.ndarray]: ...

    @overload
    def heatmap(
        self, image: Any, *, channels: Channels = ..., batch_size: int = ...
    ) -> np.ndarray: ...

    @suggest_keywords
    def heatmap(
        self, image: Any, *, channels: Channels = "rgb", batch_size: int = 1
    ) -> np.ndarray | list[np.ndarray]:
        """Compute the probability of a keypoint at each pixel.

        Args:
            image: a path, a PIL image, or an array or PyTorch tensor: uint8, uint16 or float in
                [0, 1]; grey, RGB or RGBA; channels last or first. Or several of them, in a list, a
                tuple or a batch of four dimensions; their sizes may differ.
            channels: the order of the colours in arrays and tensors: "bgr" for the images of
                `cv2.imread`.
            batch_size: of several images, the network is run once for up to so many that follow
                each other and that it sees at one size. On a processor that pays for small images
                only: larger ones take as long, and the memory of all of them.

        Returns:
            (H, W) float32 in [0, 1], at the image's own size; of several images a list, in their
            order.

        Raises:
            ImageError: an image cannot be read or is not fit.
            OptionError: the batch size is out of its range.
        """
        check_batch_size(batch_size)
        images = image_list(image)
        if images is None:
            return self.heatmap_and_logits(image, channels=channels)[0]
        return [maps.both()[0] for _, _, maps in self._run_each(images, channels, batch_size)]

    @suggest_keywords
    def heatmap_and_logits(
        self, image: Any, *, channels: Channels = "rgb"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the heat map and the logits of its probabilities, of one image.

        Float32 rounds the highest probabilities to 1. The logits still distinguish these pixels, so
        keypoints are ranked by them. Both together are all that `select_keypoints` needs to select
        again, with other options, what `detect` would find.

        Args:
            image, channels: as of `heatmap`.

        Returns:
            The heat map and the logits, (H, W) float32 both.

        Raises:
            ImageError: the image cannot be read or is not fit.
        """
        return self._run(load_image(image, channels=channels))

    def _run(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the heat map and the logits of an image that `load_image` returned."""
        with memory_named(rgb.shape):
            return compute_heatmap_and_logits(rgb, self._network, self.heatmap_options)

    def _dense(self, rgb: np.ndarray, options: SelectionOptions) -> Keypoints:
        """Find dense keypoints in an image that `load_image` returned."""
        with memory_named(rgb.shape):
            return select_from_maps(self._maps(rgb), options)

    def _maps(self, rgb: np.ndarray) -> Maps:
        """Run the network on an image that `load_image` returned."""
        return compute_maps(rgb, self._network, self.heatmap_options)

    def _points(self, rgb: np.ndarray, options: SelectionOptions) -> Keypoints:
        """Find points in an image that `load_image` returned."""
        from .points.ranker import load_ranker

        with memory_named(rgb.shape):
            return find_points(rgb, options, self.heatmap_options, load_ranker(self.ranker))

    def __repr__(self) -> str:
        shown, precision = self.heatmap_options, self._runtime.precision
        also = "" if precision == "float32" else f", precision={precision!r}"
        return (
            f"DeepDetect({self.weights.name}, resolution={shown.resolution!r}, "
            f"network_channels={shown.network_channels!r}, backend={self.backend!r}{also})"
        )

    @overload
    def detect(
        self,
        image: Images,
        threshold: float = ...,
        *,
        density: float | None = ...,
        max_keypoints: int | None = ...,
        nms_radius: int | None = ...,
        subpixel: bool | None = ...,
        ignore: np.ndarray | Images | None = ...,
        mode: Literal["auto", "dense", "points"] = ...,
        spread: Literal["none", "grid", "anms"] = ...,
        channels: Channels = ...,
        batch_size: int = ...,
        return_heatmap: Literal[False] = ...,
    ) -> list[Keypoints]: ...

    @overload
    def detect(
        self,
        image: Images,
        threshold: float = ...,
        *,
        density: float | None = ...,
        max_keypoints: int | None = ...,
        nms_radius: int | None = ...,
        subpixel: bool | None = ...,
        ignore: np.ndarray | Images | None = ...,
        mode: Literal["auto", "dense", "points"] = ...,
        spread: Literal["none", "grid", "anms"] = ...,
        channels: Channels = ...,
        batch_size: int = ...,
        return_heatmap: Literal[True],
    ) -> tuple[list[Keypoints], list[np.ndarray]]: ...

    @overload
    def detect(
        self,
        image: Any,
        threshold: float = ...,
        *,
        density: float | None = ...,
        max_keypoints: int | None = ...,
        nms_radius: int | None = ...,
        subpixel: bool | None = ...,
        ignore: np.ndarray | None = ...,
        mode: Literal["auto", "dense", "points"] = ...,
        spread: Literal["none", "grid", "anms"] = ...,
        channels: Channels = ...,
        batch_size: int = ...,
        return_heatmap: Literal[False] = ...,
    ) -> Keypoints: ...

    @overload
    def detect(
        self,
        image: Any,
        threshold: float = ...,
        *,
        density: float | None = ...,
        max_keypoints: int | None = ...,
        nms_radius: int | None = ...,
        subpixel: bool | None = ...,
        ignore: np.ndarray | None = ...,
        mode: Literal["auto", "dense", "points"] = ...,
        spread: Literal["none", "grid", "anms"] = ...,
        channels: Channels = ...,
        batch_size: int = ...,
        return_heatmap: Literal[True],
    ) -> tuple[Keypoints, np.ndarray]: ...

    @suggest_keywords
    def detect(
        self,
        image: Any,
        threshold: float = 0.5,
        *,
        density: float | None = None,
        max_keypoints: int | None = None,
        nms_radius: int | None = None,
        subpixel: bool | None = None,
        ignore: np.ndarray | Images | None = None,
        mode: Literal["auto", "dense", "points"] = "auto",
        spread: Literal["none", "grid", "anms"] = "none",
        channels: Channels = "rgb",
        batch_size: int = 1,
        return_heatmap: bool = False,
    ) -> Any:
        """Detect keypoints.

        Without `max_keypoints` they are dense: all pixels with a probability over the threshold.
        With it, they are the best ones of all scales, ranked by how surely they are found again in
        another photograph; the network is not run for them.

        Args:
            image: as for `heatmap`: one, or several in a list, a tuple or a batch.
            threshold: tau: pixels with a probability above it.
            density: wanted keypoints per pixel, in (0, 1], instead of the threshold. This many
                are returned even where there is little to detect.
            max_keypoints: at most this many, the best ones.
            nms_radius: of dense keypoints: radius of non-maximum suppression in pixels. None: 1
                with `max_keypoints`, else 0.
            subpixel: of dense keypoints: refine positions to a fraction of a pixel. None: with
                `max_keypoints` only.
            ignore: (H, W) array, true where no keypoint is wanted. Of several images one for each,
                or None, in a list or a tuple; or one array for all.
            mode: "dense", "points", or "auto": points with `max_keypoints` where none of
                threshold, density, nms_radius and subpixel is given, else dense.
            spread: of points: "none", "grid" (in turn the best of each cell), or "anms" (as far
                from each other as their number allows).
            channels, batch_size: as of `heatmap`.
            return_heatmap: return the heat map, too.

        Returns:
            The keypoints; with `return_heatmap`, the keypoints and the (H, W) float32 heat map. Of
            several images a list in their order, with `return_heatmap` two lists: the same as one
            by one, but for the last bits of those that were run together.
            Dense keypoints come in the order of rows and columns, on pixel centres unless
            `subpixel`; points come best first, with sub-pixel positions and sizes.

        Raises:
            ImageError: the image cannot be read or is not fit.
            OptionError: an option is out of its range, or options do not fit together.
        """
        options = SelectionOptions(
            threshold, density, max_keypoints, nms_radius, subpixel, None, mode, spread
        )
        check_batch_size(batch_size)
        images = image_list(image)
        masks = ignore_masks(ignore, None if images is None else len(images))
        if images is None:
            chosen = replace(options, ignore=masks[0])
            keypoints, heatmap = self._find(
                load_image(image, channels=channels), chosen, return_heatmap
            )
            return (keypoints, heatmap) if return_heatmap else keypoints
        found, heatmaps = [], []
        if options.uses_points and not return_heatmap:  # the network is not run
            for number, rgb in _load_each(images, channels):
                with image_named(number):
                    found.append(self._points(rgb, replace(options, ignore=masks[number])))
            return found
        for number, rgb, maps in self._run_each(images, channels, batch_size):
            chosen = replace(options, ignore=masks[number])
            with image_named(number), memory_named(rgb.shape):
                if options.uses_points:
                    keypoints, heatmap = self._points(rgb, chosen), maps.both()[0]
                else:
                    del rgb  # the keypoints need the room
                    keypoints, heatmap = _select(maps, chosen, return_heatmap)
            found.append(keypoints)
            heatmaps.append(heatmap)
        return (found, heatmaps) if return_heatmap else found

    def _find(
        self, rgb: np.ndarray, options: SelectionOptions, return_heatmap: bool
    ) -> tuple[Keypoints, np.ndarray | None]:
        """Find the keypoints of a loaded image, and its heat map where it is asked for."""
        if options.uses_points:
            return self._points(rgb, options), self._run(rgb)[0] if return_heatmap else None
        with memory_named(rgb.shape):
            maps = self._maps(rgb)
            del rgb  # as above
            return _select(maps, options, return_heatmap)

    def _run_each(
        self, images: list[Any], channels: Channels, batch_size: int
    ) -> Iterator[tuple[int, np.ndarray, Maps]]:
        """Load images and run the network; yield the place of each, itself and its maps."""
        options = self.heatmap_options

        def size(loaded: tuple[int, np.ndarray]) -> tuple[int, int]:
            return seen_size(loaded[1].shape, options)

        for batch in batches(_load_each(images, channels), size, batch_size):
            with image_named(batch[0][0]), memory_named(batch[0][1].shape, len(batch)):
                maps = compute_maps_of_batch([rgb for _, rgb in batch], self._network, options)
            while batch:
                yield (*batch.pop(0), maps.pop(0))


def _load_each(images: list[Any], channels: Channels) -> Iterator[tuple[int, np.ndarray]]:
    """Load images when they are asked for, each with its place in the list."""
    for number, image in enumerate(images):
        with image_named(number):
            loaded = number, load_image(image, channels=channels)
        yield loaded
        del loaded


def _select(
    maps: Maps, options: SelectionOptions, return_heatmap: bool
) -> tuple[Keypoints, np.ndarray | None]:
    """Select dense keypoints, and make the whole heat map where it is asked for."""
    if not return_heatmap:
        return select_from_maps(maps, options), None
    heatmap, logits = maps.both()
    return select_keypoints(heatmap, options, logits), heatmap


def find_keypoints(
    detector: HeatmapDetector, rgb: np.ndarray, options: SelectionOptions
) -> Keypoints:
    """Choose the keypoints of a loaded image, ranked by logits where the detector gives them.

    Other detectors than ours have a heat map only: their keypoints are dense.

    Raises:
        OptionError: the detector's map has another size than the image, or is not finite; or
            points are asked for by name of a detector that has none.
    """
    if isinstance(detector, DeepDetect):
        if options.uses_points:
            return detector._points(rgb, options)
        return detector._dense(rgb, options)
    if options.mode == "points" or options.spread != "none":
        raise OptionError("only a DeepDetect detector has points: leave out `mode` and `spread`")
    logits = None
    if hasattr(detector, "heatmap_and_logits"):
        heatmap, logits = detector.heatmap_and_logits(rgb)
    else:
        heatmap = detector.heatmap(rgb)
    if np.shape(heatmap) != rgb.shape[:2] or not np.isfinite(heatmap).all():
        raise OptionError(
            f"the detector's heat map must be {rgb.shape[:2]} finite probabilities, one per "
            f"pixel, and has shape {np.shape(heatmap)}: correct its method heatmap"
        )
    return select_keypoints(np.asarray(heatmap), options, logits)
