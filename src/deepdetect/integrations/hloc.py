"""hloc (Hierarchical-Localization): an extractor, a matcher of features, and a dense matcher.

After `register()`, hloc knows the extractor and the matcher of features by the name "deepdetect",
and the dense matcher by the name "deepdetect_dense".
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from types import ModuleType
from typing import Any

import numpy as np

from .._shared.errors import OptionError, check_name, require_packages
from ..detector.detector import AnyDetector, DeepDetect
from ..detector.point_detector import PointDetector
from ..features.keypoints import Keypoints, unit_length
from ..features.learned import LEARNED
from ..matching.pipeline import match_features, match_images
from .tensors import load_tensor

require_packages("the drop-in for hloc", "hloc", "torch")

import hloc.extractors
import hloc.matchers
import torch
from hloc.utils.base_model import BaseModel
from torch import Tensor

NAME = "deepdetect"

MAX_KEYPOINTS = np.iinfo(np.int16).max
"""Maximum number of keypoints of an image, because hloc stores keypoint indices as int16."""

EXTRACTOR_CONF: dict[str, Any] = {
    "output": "feats-deepdetect-n4096",
    "model": {"name": NAME, "max_keypoints": 4096},
    "preprocessing": {"grayscale": False, "resize_max": 1600},
}
"""Configuration for `hloc.extract_features.main`."""

MATCHER_CONF: dict[str, Any] = {
    "output": "matches-deepdetect",
    "model": {"name": NAME, "descriptor": LEARNED},
}
"""Configuration for `hloc.match_features.main`."""

DENSE_MATCHER_CONF: dict[str, Any] = {
    "output": "matches-deepdetect-dense",
    "model": {"name": f"{NAME}_dense"},
    "preprocessing": {"grayscale": False, "resize_max": 1024, "dfactor": 8},
    "max_error": 2,
    "cell_size": 8,
}
"""Configuration for `hloc.match_dense.main`. hloc merges match positions in cells of `cell_size`
pixels into one keypoint each. It assigns matches to keypoints up to `max_error` pixels away."""


class DeepDetectExtractor(BaseModel):
    """Extractor of the best keypoints of all scales and descriptors, for `hloc.extract_features`.

    The options `max_keypoints`, `spread` and `descriptor` are those of `PointDetector`; hloc's
    LightGlue needs the descriptor "rootsift". `angle_unit` is the unit of angles: "degrees" as in
    hloc's own SIFT, or "radians" as LightGlue needs. Positions are float64, because hloc rounds
    float32 positions to half precision.
    """

    default_conf: dict[str, Any] = {  # noqa: RUF012  # hloc's way to declare it
        "max_keypoints": 4096,
        "spread": "none",
        "descriptor": LEARNED,
        "angle_unit": "degrees",
    }
    required_inputs = ["image"]  # noqa: RUF012
    detection_noise = 1.0

    def _init(self, conf: dict[str, Any]) -> None:
        _check_names(conf, self.default_conf)
        check_name("angle unit", conf["angle_unit"], ("degrees", "radians"))
        count = conf["max_keypoints"]
        if count is None or count > MAX_KEYPOINTS:
            raise OptionError(f"hloc takes `max_keypoints` up to {MAX_KEYPOINTS}, not {count}")
        self._detector = PointDetector(
            conf["max_keypoints"], spread=conf["spread"], descriptor=conf["descriptor"]
        )
        self._radians = conf["angle_unit"] == "radians"

    def _forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        image = data["image"]
        points = self._detector.extract(load_tensor(image[0]))
        assert points.angles is not None
        assert points.descriptors is not None
        arrays = {
            "keypoints": points.xy.astype(np.float64),
            "scores": points.scores,
            "descriptors": unit_length(points.descriptors).T.copy(),
            "scales": points.sizes,
            "oris": np.deg2rad(points.angles) if self._radians else points.angles,
        }
        return {name: torch.from_numpy(a)[None].to(image.device) for name, a in arrays.items()}


class DeepDetectMatcher(BaseModel):
    """Nearest-neighbour matcher with the ratio test, for `hloc.match_features`.

    The options `ratio` and `mutual` are those of `match_features`. The matcher accepts descriptors
    of any extractor, if they are compared by Euclidean distance. If `descriptor` is "learned", the
    features must be those of `DeepDetectExtractor` with angles in degrees. The matcher then finds
    more matches, because it undoes the rotation between the images.
    """

    default_conf: dict[str, Any] = {  # noqa: RUF012
        "ratio": None,
        "mutual": True,
        "descriptor": None,
    }
    required_inputs = ["descriptors0", "descriptors1"]  # noqa: RUF012

    def _init(self, conf: dict[str, Any]) -> None:
        _check_names(conf, self.default_conf)
        ratio, self._descriptor = conf["ratio"], conf["descriptor"]
        if not (ratio is None or 0 < ratio <= 1):
            raise OptionError(f"`ratio` must lie in (0, 1], not {ratio}")
        self._how = {"matcher": "exact", "ratio": ratio, "mutual": bool(conf["mutual"])}

    def _forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        described = [data[name][0].T.cpu().float().numpy() for name in self.required_inputs]
        if len(described[1]) > MAX_KEYPOINTS:
            raise OptionError(
                f"hloc takes at most {MAX_KEYPOINTS} keypoints, not {len(described[1])}: use fewer"
            )
        features = []
        for side, descriptors in enumerate(described):
            count, oris = len(descriptors), data.get(f"oris{side}")
            features.append(
                Keypoints(
                    np.zeros((count, 2)),  # positions, which this matcher does not use
                    np.ones(count),
                    (1, 1),
                    angles=None if oris is None else oris[0, :count].cpu().float().numpy() % 360,
                    descriptors=np.ascontiguousarray(descriptors),
                    descriptor_type=self._descriptor,
                )
            )
        found = match_features(*features, **self._how)
        matches = np.full(len(described[0]), -1, np.int64)
        scores = np.zeros(len(described[0]), np.float32)
        matches[found.indices0], scores[found.indices0] = found.indices1, found.scores
        return {
            "matches0": torch.from_numpy(matches)[None],
            "matching_scores0": torch.from_numpy(scores)[None],
        }


class DeepDetectDenseMatcher(BaseModel):
    """Dense guided matcher of two images, for `hloc.match_dense`.

    If the option `max_keypoints` is set, the matcher uses a `PointDetector`, otherwise a
    `DeepDetect` with the option `weights`. If no geometry can be trusted, it returns no matches.
    """

    default_conf: dict[str, Any] = {"weights": "default", "max_keypoints": None}  # noqa: RUF012
    required_inputs = ["image0", "image1"]  # noqa: RUF012

    def _init(self, conf: dict[str, Any]) -> None:
        _check_names(conf, self.default_conf)
        count = conf["max_keypoints"]
        self._detector: AnyDetector = (
            DeepDetect(conf["weights"]) if count is None else PointDetector(count)
        )

    def _forward(self, data: dict[str, Tensor]) -> dict[str, Tensor]:
        # The images are swapped, because hloc expects refined positions in the first image, and
        # `match_images` refines those in the second.
        second, first = (load_tensor(data[name][0]) for name in ("image1", "image0"))
        matches = match_images(second, first, self._detector)
        arrays = {
            "keypoints0": matches.points1,
            "keypoints1": matches.points0,
            "scores": matches.scores,
        }
        device = data["image0"].device
        return {name: torch.from_numpy(a).float().to(device) for name, a in arrays.items()}


def register() -> None:
    """Register the extractor and the matchers with hloc; call this once before hloc runs."""
    models = (
        (hloc.extractors, NAME, DeepDetectExtractor),
        (hloc.matchers, NAME, DeepDetectMatcher),
        (hloc.matchers, f"{NAME}_dense", DeepDetectDenseMatcher),
    )
    for package, name, model in models:
        # hloc imports a module by name, and uses the one class whose `__module__` is that name.
        module = ModuleType(f"{package.__name__}.{name}", model.__doc__)
        model.__module__ = module.__name__
        setattr(module, model.__name__, model)
        sys.modules[module.__name__] = module
        setattr(package, name, module)


def _check_names(conf: dict[str, Any], known: Iterable[str]) -> None:
    for name in conf:
        check_name("option", name, ("name", *known))
