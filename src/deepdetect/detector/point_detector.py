"""`PointDetector`, which finds the best keypoints of an image at all scales, and ranks them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

from .._shared.errors import OptionError, check_name
from .._shared.image_array import Channels
from .._shared.machine import limited_threads
from .._shared.opencv import cv2
from .._shared.options import check_ranges, names_a_file, suggest_keywords
from .._shared.records import file_digest
from ..features.keypoints import Keypoints
from ..features.learned import LEARNED
from ..features.selection import check_ignore, check_max_keypoints, without_frame
from ..features.sift import ROOT_SIFT, describe_keypoints
from ..io.image import Images, found_in_each, load_image, load_pixels, load_visible, luma
from .backends import RuntimeOptions, backend_name
from .heatmap import MAX_AUTO_PIXELS, memory_named
from .points.by_graph import detect_by_graph, open_points
from .points.descriptor import DESCRIPTOR_GRAPHS, describe_batch, descriptor_type
from .points.detection import SPREADS, Spread, detect_points
from .points.ranker import load_ranker
from .pretrained import RANKER


@runtime_checkable
class Descriptor(Protocol):
    """Anything that describes keypoints, such as `PointDetector`."""

    def describe(self, image: Any, keypoints: Keypoints) -> Keypoints:
        """Return the given keypoints of an image with descriptors and their type."""


class _Seen(NamedTuple):
    """An image's luma and mask, both perhaps scaled down, and its (width, height)."""

    gray: np.ndarray
    ignore: np.ndarray | None
    whole: tuple[int, int]


class PointDetector:
    """A detector of the best keypoints of all scales.

    Keypoints are maxima of |det Hessian|. A small trained network, not that of `DeepDetect`, ranks
    them by how likely they are to be found again in another image. A few thousand of these
    keypoints give more correct matches than as many pixels of `DeepDetect`'s heat map.

    Args:
        max_keypoints: maximum number of keypoints per image. None: all.
        spread: how keypoints are chosen if there are more than `max_keypoints`. "none" takes those
            ranked highest. "grid" takes the best of each cell of a grid, then the second-best of
            each, and so on. "anms" takes good keypoints that are as far apart as possible.
        min_logit: minimum `Keypoints.logits` of a keypoint. None: no limit. At 7.75, photographs
            have about as many keypoints as `cv2.SIFT` finds.
        upright: give all keypoints the angle 0, which keeps more matches of images that are not
            rotated relative to each other. Use this for programs that compare descriptors as they
            are, such as `cv2.BFMatcher`; `match_features` does about as well without it.
        resolution: "auto" (images over two megapixels are scaled down to that) or "native" (images
            keep their size).
        ranker: npz file of the network that ranks the keypoints, written by `deepdetect dev
            train-points`. None: the bundled file.
        descriptor: what describes the keypoints. "learned" is a small network that also sees the
            surroundings of a keypoint. "learned-free" was trained only on freely licensed images.
            "cross-modal" applies "learned" to the edge strength, for images of different sensors,
            such as infrared and visible light, or for maps. "rootsift" is for programs that expect
            SIFT descriptors. A path is an ONNX file written by `deepdetect train-descriptor`. An
            object must have a method `describe(image, keypoints)` like that of this class.
        backend: "auto" (the fastest on the device), or "onnxruntime" or "openvino", which run an
            ONNX graph of the detector. On a CPU, the graph takes a multiple of the time.
        device: "cpu", "cuda", the name of any execution provider of ONNX Runtime or, if the backend
            is "openvino", of a device of OpenVINO, such as "gpu".
        threads: maximum number of threads. None: one per processor.
        precision: "float32", the only number format in which positions stay exact.

    Raises:
        WeightsError: the ranker or the descriptor is missing, damaged or unsuitable.
        OptionError: an option is unknown, out of its range, or not available on the device.

    Example:
        >>> image = np.zeros((64, 64), np.uint8)
        >>> image[20:40, 24:44] = 255
        >>> points = PointDetector(max_keypoints=4)
        >>> len(points.detect(image)), points.extract(image).descriptors.shape
        (4, (4, 64))
    """

    @suggest_keywords
    def __init__(
        self,
        max_keypoints: int | None = 2048,
        *,
        spread: Spread = "none",
        min_logit: float | None = None,
        upright: bool = False,
        resolution: Literal["auto", "native"] = "auto",
        ranker: str | Path | None = None,
        descriptor: str | Path | Descriptor = LEARNED,
        backend: str = "auto",
        device: str = "cpu",
        threads: int | None = None,
        precision: str = "float32",
    ) -> None:
        check_max_keypoints(max_keypoints)
        if precision != "float32":
            raise OptionError(
                f"`precision={precision!r}` is not available in PointDetector: leave it out, or "
                "use a DeepDetect"
            )
        self.threads = threads
        self._runtime = RuntimeOptions(backend, device, threads)
        name = backend_name(self._runtime)
        self._by_graph = (backend, device) != ("auto", "cpu")
        self.runtime = f"{name}, {device}" if self._by_graph else "compiled"
        check_name("spread", spread, SPREADS)
        if spread != "none" and max_keypoints is None:
            raise OptionError(f"`spread={spread!r}` needs `max_keypoints`, the number to spread")
        check_name("resolution of points", resolution, ("auto", "native"))
        self.max_keypoints = None if max_keypoints is None else int(max_keypoints)
        self.spread, self.upright, self.resolution = spread, bool(upright), resolution
        self.min_logit = min_logit
        check_ranges(self, between={"min_logit": (-1000, 1000)})
        unusual = {
            "spread": spread != "none",
            "ranker": ranker is not None,
            "max_keypoints": max_keypoints is None,
        }
        for name in (name for name, used in unusual.items() if used and self._by_graph):
            raise OptionError(
                f"`{name}` as given works only without `backend` and `device`: leave these out, or "
                f"change `{name}`"
            )
        if self._by_graph:
            open_points(self._runtime)
        self.ranker = RANKER if ranker is None else Path(ranker).absolute()
        self._ranker = load_ranker(self.ranker)
        if isinstance(descriptor, Descriptor):
            kind = getattr(descriptor, "descriptor_type", type(descriptor).__name__)
        elif names_a_file(descriptor):
            descriptor = Path(descriptor).absolute()
            kind = descriptor_type(descriptor)
        else:
            check_name("descriptor", descriptor, (*DESCRIPTOR_GRAPHS, ROOT_SIFT))
            kind = str(descriptor)
        self.descriptor, self.descriptor_type = descriptor, kind

    @property
    def settings(self) -> dict[str, Any]:
        """All that determines the keypoints of an image: options and the digest of the ranker."""
        return {
            "detector": "points",
            "runtime": self.runtime,
            "ranker": file_digest(self.ranker),
            "max_keypoints": self.max_keypoints,
            "spread": self.spread,
            "min_logit": self.min_logit,
            "upright": self.upright,
            "resolution": self.resolution,
        }

    @suggest_keywords
    def detect(
        self,
        image: Any,
        *,
        max_keypoints: int | None = None,
        ignore: np.ndarray | None = None,
        channels: Channels = "rgb",
    ) -> Keypoints:
        """Detect the best keypoints of an image.

        Args:
            image: anything `load_image` takes.
            max_keypoints: maximum number of keypoints. None: the detector's `max_keypoints`.
            ignore: (H, W) array, true where no keypoint is wanted.
            channels: order of the colours in arrays and tensors: "rgb", or "bgr" as in OpenCV.

        Returns:
            The keypoints, best first, with sub-pixel positions, sizes and angles. Scores rank the
            keypoints, but are not probabilities.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: an option is out of its range, or the mask has another size than the image.
        """
        seen = self._seen(load_pixels(image, channels), ignore)
        return self._detected([seen], max_keypoints)[0]

    @suggest_keywords
    def detect_batch(
        self,
        images: Images,
        *,
        max_keypoints: int | None = None,
        ignore: np.ndarray | Images | None = None,
        channels: Channels = "rgb",
    ) -> list[Keypoints]:
        """Detect the best keypoints of several images.

        Args:
            images: a list or tuple of images of any sizes, or an array of four dimensions.
            ignore: one mask for all images, or a list or tuple with a mask or None for each image.
            max_keypoints, channels: see `detect`.

        Returns:
            The keypoints of each image, in the order of the images.

        Raises:
            ImageError: an image cannot be read or is unsuitable.
            OptionError: a mask has another size than its image.
        """
        if self._by_graph:
            seen = found_in_each(images, channels, ignore, self._seen)
            return self._detected(seen, max_keypoints)

        def detected(rgb: np.ndarray, mask: np.ndarray | None) -> Keypoints:
            return self._detected([self._seen(rgb, mask)], max_keypoints)[0]

        return found_in_each(images, channels, ignore, detected)

    @suggest_keywords
    def extract(
        self,
        image: Any,
        *,
        max_keypoints: int | None = None,
        ignore: np.ndarray | None = None,
        channels: Channels = "rgb",
    ) -> Keypoints:
        """Detect the best keypoints of an image, and describe them.

        Args:
            image, max_keypoints, ignore, channels: see `detect`.

        Returns:
            The keypoints as from `detect`, described at their own sizes and angles. Learned
            descriptors are (N, 64) float32 unit vectors, RootSIFT is (N, 128) uint8.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: the mask has another size than the image.
            WeightsError: the ONNX file of the descriptor is damaged.
        """
        return self._extracted(load_pixels(image, channels), ignore, max_keypoints)

    @suggest_keywords
    def extract_batch(
        self,
        images: Images,
        *,
        max_keypoints: int | None = None,
        ignore: np.ndarray | Images | None = None,
        channels: Channels = "rgb",
    ) -> list[Keypoints]:
        """Detect the best keypoints of several images, and describe them.

        With `backend` or `device`, learned descriptors and points of all images of one size are
        computed at once, which is faster on a graphics card, and takes memory for all of them.

        Args:
            images, max_keypoints, ignore, channels: see `detect_batch`.

        Returns:
            The keypoints of each image as from `extract`, in the order of the images.

        Raises:
            ImageError: an image cannot be read or is unsuitable.
            OptionError: a mask has another size than its image.
            WeightsError: the ONNX file of the descriptor is damaged.
        """
        if self._by_graph and self._is_network:
            seen = found_in_each(images, channels, ignore, self._seen)
            return self._described(
                [each.gray for each in seen], self._detected(seen, max_keypoints)
            )
        return found_in_each(
            images, channels, ignore, lambda rgb, mask: self._extracted(rgb, mask, max_keypoints)
        )

    @suggest_keywords
    def describe(
        self, image: Any, keypoints: Keypoints, *, channels: Channels = "rgb"
    ) -> Keypoints:
        """Describe keypoints of this or another detector, as `extract` does.

        Args:
            image, channels: see `detect`.
            keypoints: keypoints of the image. Learned descriptors need their sizes. Angles that
                are missing or -1 are replaced by the dominant gradient orientations.

        Raises:
            ImageError: the image cannot be read or is unsuitable.
            OptionError: a size is not above 0, or keypoints for learned descriptors have no sizes.
            WeightsError: the ONNX file of the descriptor is damaged.
        """
        rgb = load_image(image, channels=channels)
        if isinstance(self.descriptor, Descriptor):
            return self.descriptor.describe(rgb, keypoints)
        gray = luma(rgb)
        with limited_threads(self.threads):
            if self.descriptor_type == ROOT_SIFT:
                return describe_keypoints(gray, keypoints)
        return self._described([self._scaled(gray)], [keypoints])[0]

    def __repr__(self) -> str:
        return (
            f"PointDetector(max_keypoints={self.max_keypoints}, spread={self.spread!r}, "
            f"upright={self.upright}, resolution={self.resolution!r}, ranker={self.ranker.name}, "
            f"descriptor={str(self.descriptor)!r}, runtime={self.runtime!r})"
        )

    @property
    def _is_network(self) -> bool:
        """Whether descriptors are computed by a network from the luma."""
        return not isinstance(self.descriptor, Descriptor) and self.descriptor_type != ROOT_SIFT

    def _extracted(
        self, rgb: np.ndarray, ignore: np.ndarray | None, max_keypoints: int | None
    ) -> Keypoints:
        seen = self._seen(rgb, ignore)
        found = self._detected([seen], max_keypoints)[0]
        if self._is_network:
            return self._described([seen.gray], [found])[0]
        return self.describe(rgb, found)

    def _seen(self, rgb: np.ndarray, ignore: np.ndarray | None) -> _Seen:
        rgb, ignore = load_visible(rgb, ignore=ignore)
        gray = luma(rgb)
        whole = gray.shape[::-1]
        if ignore is not None:
            ignore = check_ignore(ignore, gray.shape)
        ignore = without_frame(rgb, ignore)
        gray = self._scaled(gray)
        size = gray.shape[::-1]
        if size != whole and ignore is not None:
            # A scaled pixel is ignored if it or one of its 8 neighbours covers an ignored pixel.
            share = cv2.resize(ignore.astype(np.float32), size, interpolation=cv2.INTER_AREA)
            ignore = cv2.dilate((share > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
        return _Seen(gray, ignore, whole)

    def _detected(self, seen: Sequence[_Seen], max_keypoints: int | None) -> list[Keypoints]:
        check_max_keypoints(max_keypoints)
        most = self.max_keypoints if max_keypoints is None else int(max_keypoints)

        def detect(grays: list[np.ndarray], ignore: list[np.ndarray | None]) -> list[Keypoints]:
            if self._by_graph:
                assert most is not None
                return detect_by_graph(grays, most, self._runtime, ignore, self.min_logit)
            return [
                detect_points(
                    gray,
                    most,
                    spread=self.spread,
                    ignore=mask,
                    ranker=self._ranker,
                    min_logit=self.min_logit,
                )
                for gray, mask in zip(grays, ignore, strict=True)
            ]

        found = self._by_size(detect, [each.gray for each in seen], [each.ignore for each in seen])
        return [self._at_full_size(*each) for each in zip(found, seen, strict=True)]

    def _described(
        self, grays: Sequence[np.ndarray], keypoints: Sequence[Keypoints]
    ) -> list[Keypoints]:
        assert isinstance(self.descriptor, (str, Path))
        options = self._runtime if self._by_graph else RuntimeOptions()
        describe = partial(describe_batch, descriptor=self.descriptor, runtime=options)
        return self._by_size(describe, grays, keypoints)

    def _by_size(
        self,
        run: Callable[[list[np.ndarray], list[Any]], list[Keypoints]],
        grays: Sequence[np.ndarray],
        others: Sequence[Any],
    ) -> list[Keypoints]:
        """Call `run` once for the images of each size or, without a graph, once for each image."""
        groups: dict[Any, list[int]] = {}
        for k, (gray, other) in enumerate(zip(grays, others, strict=True)):
            # A mask changes the number of keypoints for which the graph runs.
            key = (gray.shape, isinstance(other, np.ndarray)) if self._by_graph else k
            groups.setdefault(key, []).append(k)
        results: dict[int, Keypoints] = {}
        for rows in groups.values():
            some = [grays[k] for k in rows]
            with memory_named(some[0].shape, len(some)), limited_threads(self.threads):
                found = run(some, [others[k] for k in rows])
            results |= zip(rows, found, strict=True)
        return [results[k] for k in range(len(grays))]

    def _at_full_size(self, found: Keypoints, seen: _Seen) -> Keypoints:
        if self.upright:
            found = replace(found, angles=np.zeros(len(found), np.float32))
        if found.image_size == seen.whole:
            return found
        assert found.sizes is not None
        factor = np.divide(seen.whole, found.image_size)
        xy, sizes = (found.xy + 0.5) * factor - 0.5, found.sizes * factor.mean()
        return replace(found, xy=xy, image_size=seen.whole, sizes=sizes)

    def _scaled(self, gray: np.ndarray) -> np.ndarray:
        height, width = gray.shape
        scale = (MAX_AUTO_PIXELS / gray.size) ** 0.5
        if self.resolution == "native" or scale >= 1:
            return gray
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        return cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
