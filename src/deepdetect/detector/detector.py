"""`DeepDetect`, which runs the network on images to get heat maps or dense keypoints."""

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
    without_frame,
)
from ..features.sift import describe_keypoints
from ..io.image import (
    Images,
    found_in_each,
    load_image,
    load_pixels,
    load_visible,
    luma,
)
from .backends import RuntimeOptions, open_network
from .heatmap import HeatmapOptions, compute_maps, memory_named
from .pretrained import PRETRAINED, resolve_weights

CHANNELS_OF_IMAGES = (
    "give `channels` with each image, as in detect(image, channels='bgr'); `network_channels` is "
    "the order in the network's own input"
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
        """Return the probabilities that the pixels of an image are keypoints, (H, W) float32."""


AnyDetector = Detector | HeatmapDetector


class DeepDetect:
    """The dense keypoint detector of the paper.

    Its keypoints are pixels to which the network gives a high probability. A few thousand keypoints
    of `PointDetector` give more correct matches than as many pixels: use that if you need few.

    Args:
        weights: name of bundled weights ("default", "dense", "free" or "espnet"), or an ONNX file.
        max_keypoints: maximum number of keypoints per image; the most probable pixels are kept.
            None: all pixels above the threshold.
        resolution: "auto" (images over two megapixels are scaled down to that), "native" (images
            keep their size), or a number of pixels: images of any shape are resized to a square of
            that side. The paper uses 480.
        backend: "auto" (OpenVINO for bfloat16, else ONNX Runtime), "onnxruntime" or "openvino".
        device: "cpu", "cuda", or the name of any execution provider of ONNX Runtime.
        threads: number of threads. None: the backend's choice.
        precision: number format of the network, "float32" or "bfloat16". bfloat16 is faster, but
            needs OpenVINO and a processor with instructions for it, changes a few keypoints, and
            does not allow tiles.
        network_channels: order of the colours in the network's input: "rgb", or "bgr" as in the
            paper's published code. For images read by OpenCV keep "rgb", and call the methods with
            `channels="bgr"`.
        tta: "none", or "flip", which averages the logits over eight flips and quarter turns of the
            image: flipped or turned images get the same keypoints, in eight times the time.
        tile_megapixels: size, in megapixels, of the tiles into which larger images are divided if
            the resolution is "native". Tiles take less memory and about twice the time. "auto": an
            image is divided only if memory is short. The weights "espnet" cannot run in tiles.

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
        """Load `deepdetect.onnx` from a folder that `deepdetect train` or a model hub has written.

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
        # Bundled weights are pickled by name, because their path differs between machines.
        vars(self).update(state, weights=resolve_weights(state["_portable"]))
        self._network, self.backend = open_network(self.weights, self._runtime)

    @property
    def runtime(self) -> str:
        """The backend, and the precision if it is not float32, such as "openvino, bfloat16"."""
        precision = self._runtime.precision
        return self.backend if precision == "float32" else f"{self.backend}, {precision}"

    @property
    def settings(self) -> dict[str, Any]:
        """All that determines the keypoints of an image: options and the digest of the weights."""
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
            channels: colour order of arrays and tensors: "rgb", or "bgr" as from `cv2.imread`.

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

        Float32 rounds the highest probabilities to 1, but logits still rank these pixels. Given the
        two maps, `select_keypoints` returns the same keypoints as `detect` with the same options.

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
            density: keypoints per pixel, in (0, 1]. If set, the threshold is not used: the most
                probable pixels are returned, even if there is little to detect.
            max_keypoints: maximum number of keypoints; the most probable pixels are kept. None: the
                detector's `max_keypoints`.
            nms_radius: radius of non-maximum suppression in pixels (0: none).
            subpixel: refine positions to a fraction of a pixel.
            ignore: (H, W) array, true where no keypoint is wanted.
            channels: see `heatmap`.

        Returns:
            Keypoints in row-major order, on pixel centres unless `subpixel` is set. Their scores
            are probabilities.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or the mask has another size than the image.
        """
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, subpixel)
        return self._select(load_pixels(image, channels), options, ignore)

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
            images: a list or tuple of images of any sizes, or an array of four dimensions.
            threshold, density, max_keypoints, nms_radius, subpixel, channels: see `detect`.
            ignore: one mask for all images, or a list or tuple with a mask or None for each image.

        Returns:
            The keypoints of each image, in the order of the images.

        Raises:
            ImageError: an image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or a mask has another size than its image.
        """
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, subpixel)
        return found_in_each(
            images, channels, ignore, lambda rgb, mask: self._select(rgb, options, mask)
        )

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
            The keypoints as from `detect`, with (N, 128) uint8 descriptors. As in the paper, all
            are described upright and with a diameter of 3 pixels.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or the mask has another size than the image.
        """
        rgb = load_pixels(image, channels)
        options = SelectionOptions(threshold, density, max_keypoints, nms_radius, subpixel)
        return describe_keypoints(luma(rgb), self._select(rgb, options, ignore))

    def _select(
        self, rgb: np.ndarray, options: SelectionOptions, ignore: np.ndarray | None
    ) -> Keypoints:
        if options.max_keypoints is None:
            options = replace(options, max_keypoints=self.max_keypoints)
        rgb, ignore = load_visible(rgb, ignore=ignore)
        with memory_named(rgb.shape):
            ignore = without_frame(rgb, ignore)
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
    """Find the keypoints of a (H, W, 3) or (H, W, 4) uint8 image with any detector.

    A detector is any object with a method `detect` or `heatmap` like those of this package. If the
    detector has heat maps, `selection` tells which pixels become keypoints (None: above 0.5).
    """
    check_selection(detector, selection)
    rgb, ignore = load_visible(rgb, ignore=ignore)
    if not hasattr(detector, "heatmap"):
        if not hasattr(detector, "detect"):
            raise OptionError(f"the detector {detector!r} has no method detect: use a DeepDetect")
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
