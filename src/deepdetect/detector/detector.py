"""The network as a detector: an image in, a heat map or dense keypoints out."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Protocol, Self

import numpy as np

from .._shared.errors import OptionError
from .._shared.image_array import Channels
from .._shared.options import suggest_keywords
from .._shared.records import file_digest
from ..features.keypoints import Keypoints
from ..features.selection import (
    SelectionOptions,
    check_max_keypoints,
    select_from_maps,
    select_keypoints,
)
from ..features.sift import describe_keypoints
from ..io.image import Images, batch_length, ignore_masks, image_named, load_each, load_image, luma
from .backends import RuntimeOptions, open_network
from .heatmap import HeatmapOptions, compute_maps, memory_named
from .pretrained import PRETRAINED, resolve_weights

CHANNELS_OF_IMAGES = (
    "give it with each image, as in detect(image, channels='bgr'); the network's own input is "
    "`network_channels`"
)


class Detector(Protocol):
    """Anything that finds keypoints, such as `DeepDetect` and `PointDetector`."""

    def detect(
        self, image: Any, *, ignore: np.ndarray | None = None, channels: Channels = "rgb"
    ) -> Keypoints:
        """Detect the keypoints of one image."""


class HeatmapDetector(Protocol):
    """Anything that computes heat maps, from which keypoints can be selected."""

    def heatmap(self, image: Any) -> np.ndarray:
        """Map an image to a (H, W) float32 probability of a keypoint."""


AnyDetector = Detector | HeatmapDetector


class DeepDetect:
    """The dense keypoint detector of the paper.

    Its keypoints are pixels of the network's heat map. If you want a few thousand keypoints,
    `PointDetector` finds better ones than the most probable pixels, without the network.

    Args:
        weights: name of bundled weights ("default", "dense", "free" or "espnet"), or an ONNX file.
        max_keypoints: maximum number of keypoints per image, the most probable pixels. None: all
            above the threshold. For a few thousand, `PointDetector` finds better ones.
        resolution: "auto" (images over two megapixels are scaled down to that), "native" (images
            keep their size), or a number of pixels: the image is squashed to a square of that side,
            as in the paper with 480.
        backend: "auto" (ONNX Runtime, OpenVINO for bfloat16), "onnxruntime" or "openvino".
        device: "cpu", "cuda", or the name of any execution provider of ONNX Runtime.
        threads: number of threads. None: the backend's choice.
        precision: number format of the network, "float32", or "bfloat16" with OpenVINO, which is
            faster on processors with instructions for it. A few keypoints differ, and tiles are not
            available.
        network_channels: order of the colours in the network's input: "rgb", or "bgr" as in the
            paper's published code. For images of OpenCV keep "rgb", and call the methods with
            `channels="bgr"`.
        tta: "flip" averages over flips and quarter turns, so that a flipped or rotated image has
            the same keypoints, in eight times the time.
        tile_megapixels: size in megapixels of the tiles into which larger images are divided, with
            resolution "native". Tiles take less memory and about twice the time. "auto": tiles only
            if memory is short. Only weights of the network `fast` can be tiled.

    Attributes:
        backend: name of the backend in use.
        heatmap_options: how images are prepared for the network.

    Raises:
        WeightsError: the weights are missing, damaged or unsuitable.
        OptionError: an option is unknown or out of its range.
        MissingExtraError: the backend is not installed.

    Example:
        >>> import numpy as np
        >>> image = np.zeros((48, 64), np.uint8)
        >>> image[16:32, 16:48] = 255
        >>> detector = DeepDetect(max_keypoints=10)
        >>> detector.heatmap(image).shape
        (48, 64)
        >>> len(detector.detect(image)), len(detector.detect(image, max_keypoints=5))
        (10, 5)
    """

    @functools.partial(suggest_keywords, elsewhere={"channels": CHANNELS_OF_IMAGES})
    def __init__(
        self,
        weights: str | Path = "default",
        *,
        max_keypoints: int | None = None,
        resolution: Literal["auto", "native"] | int = "auto",
        backend: str = "auto",
        device: str = "cpu",
        threads: int | None = None,
        precision: Literal["float32", "bfloat16"] = "float32",
        network_channels: Channels = "rgb",
        tta: Literal["none", "flip"] = "none",
        tile_megapixels: float | Literal["auto"] = "auto",
    ) -> None:
        check_max_keypoints(max_keypoints)
        self.max_keypoints = max_keypoints
        self.weights = resolve_weights(weights)
        self.heatmap_options = HeatmapOptions(resolution, network_channels, tta, tile_megapixels)
        self._portable = weights if weights in PRETRAINED else self.weights.absolute()
        self._runtime = RuntimeOptions(backend, device, threads, precision)
        self._network, self.backend = open_network(self.weights, self._runtime)

    @classmethod
    def from_pretrained(cls, folder: str | Path, **options: Any) -> Self:
        """Load the network `deepdetect.onnx` of a folder, as `train` and model hubs write it.

        Args:
            folder: a folder on this computer; nothing is downloaded.
            **options: options of `DeepDetect`.

        Raises:
            WeightsError: the folder or its deepdetect.onnx is missing, damaged or unsuitable.

        Example:
            >>> DeepDetect.from_pretrained("run/", resolution="native")  # doctest: +SKIP
        """
        return cls(Path(folder, "deepdetect.onnx"), **options)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "_network"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # A pickled detector opens its network again, by names that are the same on all machines.
        vars(self).update(state, weights=resolve_weights(state["_portable"]))
        self._network, self.backend = open_network(self.weights, self._runtime)

    @property
    def runtime(self) -> str:
        """What runs the network, such as "openvino, bfloat16": results depend on it."""
        precision = self._runtime.precision
        return self.backend if precision == "float32" else f"{self.backend}, {precision}"

    @property
    def settings(self) -> dict[str, Any]:
        """Options and the digest of the weights: what heat maps depend on besides the image."""
        return {
            "detector": "network",
            "max_keypoints": self.max_keypoints,
            "weights": file_digest(self.weights),
            "backend": self.runtime,
            **vars(self.heatmap_options),
        }

    @suggest_keywords
    def configured(self, heatmap_options: HeatmapOptions) -> DeepDetect:
        """Return a detector with the same loaded network and other heat map options."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, heatmap_options=heatmap_options)
        return other

    @suggest_keywords
    def with_weights(self, weights: str | Path) -> DeepDetect:
        """Return a detector with other weights and the same options."""
        options = vars(self._runtime) | vars(self.heatmap_options)
        return DeepDetect(weights, max_keypoints=self.max_keypoints, **options)

    @suggest_keywords
    def heatmap(self, image: Any, *, channels: Channels = "rgb") -> np.ndarray:
        """Compute the probability of a keypoint at each pixel.

        Args:
            image: a path, a PIL image, or an array or PyTorch tensor: uint8, uint16 or float in
                [0, 1]; grey, RGB or RGBA; channels last or first.
            channels: order of the colours in arrays and tensors: "rgb", or "bgr" for images of
                `cv2.imread`.

        Returns:
            (H, W) float32 in [0, 1], at the image's own size.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
        """
        return self.heatmap_and_logits(image, channels=channels)[0]

    @suggest_keywords
    def heatmap_and_logits(
        self, image: Any, *, channels: Channels = "rgb"
    ) -> tuple[np.ndarray, np.ndarray]:
        """Compute the heat map and the logits of its probabilities for one image.

        Float32 rounds the highest probabilities to 1, but logits still rank these pixels. From the
        two maps `select_keypoints` selects the keypoints that `detect` finds, with any options.

        Args:
            image, channels: see `heatmap`.

        Returns:
            The heat map and the logits, (H, W) float32 each.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
        """
        rgb = load_image(image, channels=channels)
        with memory_named(rgb.shape):
            return compute_maps(rgb, self._network, self.heatmap_options).both()

    @suggest_keywords
    def detect(
        self,
        image: Any,
        threshold: float = 0.5,
        *,
        density: float | None = None,
        max_keypoints: int | None = None,
        nms_radius: int = 0,
        subpixel: bool = False,
        ignore: np.ndarray | None = None,
        channels: Channels = "rgb",
    ) -> Keypoints:
        """Detect the dense keypoints of an image: pixels with a probability above the threshold.

        Args:
            image: see `heatmap`.
            threshold: minimum probability of a keypoint (tau in the paper).
            density: keypoints per pixel, in (0, 1], instead of a threshold. This many are returned
                even if there is little to detect.
            max_keypoints: maximum number, the most probable pixels. None: that of the detector.
            nms_radius: radius of non-maximum suppression in pixels (0: none).
            subpixel: refine positions to a fraction of a pixel.
            ignore: (H, W) array, true where no keypoint is wanted.
            channels: see `heatmap`.

        Returns:
            The keypoints in row-major order, on pixel centres unless `subpixel`, with probabilities
            as scores.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or the mask has another size.
        """
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, subpixel)
        return self._select(load_image(image, channels=channels), options, ignore)

    @suggest_keywords
    def detect_batch(
        self,
        images: Images,
        threshold: float = 0.5,
        *,
        density: float | None = None,
        max_keypoints: int | None = None,
        nms_radius: int = 0,
        subpixel: bool = False,
        ignore: np.ndarray | Images | None = None,
        channels: Channels = "rgb",
    ) -> list[Keypoints]:
        """Detect the dense keypoints of several images.

        Args:
            images: in a list, a tuple or an array of four dimensions; their sizes may differ.
            threshold, density, max_keypoints, nms_radius, subpixel, channels: see `detect`.
            ignore: a mask for each image, or None, in a list or a tuple; or one array for all.

        Returns:
            The keypoints of each image, in the order of the images.

        Raises:
            ImageError: an image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or a mask has another size.
        """
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, subpixel)
        masks, found = ignore_masks(ignore, batch_length(images)), []
        for number, rgb in load_each(images, channels):
            with image_named(number):
                found.append(self._select(rgb, options, masks[number]))
        return found

    @suggest_keywords
    def extract(
        self,
        image: Any,
        threshold: float = 0.5,
        *,
        density: float | None = None,
        max_keypoints: int | None = None,
        nms_radius: int = 0,
        subpixel: bool = False,
        ignore: np.ndarray | None = None,
        channels: Channels = "rgb",
    ) -> Keypoints:
        """Detect the dense keypoints of an image, and describe them by RootSIFT.

        Args:
            image, threshold, density, max_keypoints, nms_radius, subpixel, ignore, channels: see
                `detect`.

        Returns:
            The keypoints as from `detect`, with (N, 128) uint8 descriptors, all of size 3 and
            upright as in the paper.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or the mask has another size.
        """
        rgb = load_image(image, channels=channels)
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, subpixel)
        return describe_keypoints(luma(rgb), self._select(rgb, options, ignore))

    def _select(
        self, rgb: np.ndarray, options: SelectionOptions, ignore: np.ndarray | None
    ) -> Keypoints:
        if options.max_keypoints is None:
            options = replace(options, max_keypoints=self.max_keypoints)
        with memory_named(rgb.shape):
            maps = compute_maps(rgb, self._network, self.heatmap_options)
            del rgb  # frees memory for the keypoints
            return select_from_maps(maps, options, ignore)

    def __repr__(self) -> str:
        shown = self.heatmap_options
        return (
            f"DeepDetect({self.weights.name}, resolution={shown.resolution!r}, "
            f"network_channels={shown.network_channels!r}, backend={self.runtime!r})"
        )


def check_selection(detector: AnyDetector, selection: SelectionOptions | None) -> None:
    """Raise an OptionError if selection options are given for a detector without heat maps."""
    if selection is not None and not hasattr(detector, "heatmap"):
        raise OptionError(
            "`selection` needs a detector with a heat map: leave it out, or use a DeepDetect"
        )


def find_keypoints(
    detector: AnyDetector,
    rgb: np.ndarray,
    selection: SelectionOptions | None = None,
    ignore: np.ndarray | None = None,
) -> Keypoints:
    """Find the keypoints of a (H, W, 3) uint8 image, ranked by logits if it has any.

    The detector may be any object with a method `heatmap` or `detect` like the detectors of this
    package. The selection applies to heat maps. None selects pixels with a probability above 0.5.
    """
    check_selection(detector, selection)
    if not (hasattr(detector, "heatmap") or hasattr(detector, "detect")):
        raise OptionError(f"the detector {detector!r} has no method detect: use a DeepDetect")
    if hasattr(detector, "detect") and not hasattr(detector, "heatmap"):
        found = detector.detect(rgb, ignore=ignore)
        if not ((found.xy >= -0.5) & (found.xy < np.array(rgb.shape[1::-1]) - 0.5)).all():
            raise OptionError(
                "the detector has found keypoints outside the image: correct its method detect"
            )
        return found
    options = selection or SelectionOptions()
    if isinstance(detector, DeepDetect):
        return detector._select(rgb, options, ignore)
    heatmap = detector.heatmap(rgb)
    if np.shape(heatmap) != rgb.shape[:2] or not np.isfinite(heatmap).all():
        raise OptionError(
            f"the detector's heat map must be finite and of shape {rgb.shape[:2]}, but its shape "
            f"is {np.shape(heatmap)}: correct its method heatmap"
        )
    return select_keypoints(np.asarray(heatmap), options, ignore=ignore)
