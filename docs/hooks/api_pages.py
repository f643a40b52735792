"""The pages of the Python interface: the names on each page; mkdocstrings writes the rest.

A test checks that each name that `import deepdetect` exports is on one of the pages. Names of
deepdetect-lab begin with `LAB`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "src" / "deepdetect"

LAB = "deepdetect_lab."

WHOLE_NAME = "\n    options:\n      show_root_full_path: true"
"""Option of mkdocstrings that shows the full name of a module, by which it is imported."""


@dataclass(frozen=True)
class ApiPage:
    """A page: its address, title, introduction, and the names that it documents."""

    uri: str
    title: str
    introduction: str
    names: tuple[str, ...]

    def text(self) -> str:
        """Return the page in Markdown."""
        blocks = "\n\n".join(
            f"::: {name if name.startswith(LAB) else f'deepdetect.{name}'}"
            + (WHOLE_NAME if is_module(name) else "")
            for name in self.names
        )
        return f"# {self.title}\n\n{self.introduction}\n\n{blocks}\n"


def is_module(name: str) -> bool:
    """Return whether a name belongs to a module or package, not to one of its members."""
    path = PACKAGE.joinpath(*name.split("."))
    return (path / "__init__.py").is_file() or path.with_suffix(".py").is_file()


_PAGES = (
    ApiPage(
        "api/detection.md",
        "Detection",
        "Keypoints of photographs. Example code: [Python](../python.md#detect).",
        (
            "DeepDetect",
            "PointDetector",
            "detector.HeatmapOptions",
            "Keypoints",
            "SelectionOptions",
            "features.select_keypoints",
            "load_image",
        ),
    ),
    ApiPage(
        "api/matching.md",
        "Matching",
        "Matches between two photographs. Guide: [matching](../matching.md).",
        (
            "match_images",
            "match_features",
            "Matches",
            "features.TwoViewGeometry",
            "features.Layer",
            "features.Evidence",
            "estimate_geometry",
            "geometry.Geometry",
            "geometry.GeometryOptions",
        ),
    ),
    ApiPage(
        "api/registration.md",
        "Registration and panoramas",
        "Images of a plane, or from one place. "
        "Guide: [registration and panoramas](../matching.md#registration-and-panoramas).",
        (
            "register",
            "matching.Registration",
            "stitch",
            "matching.Panorama",
            "matching.StitchingOptions",
        ),
    ),
    ApiPage(
        "api/reconstruction.md",
        "3D reconstruction",
        "From [two photographs](../reconstruction.md), or from "
        "[three and more](../reconstruction.md#many-images).",
        (
            "reconstruct",
            "reconstruction.Reconstruction",
            "reconstruction.PointFilterOptions",
            "disparity_map",
            "matching.DisparityMap",
            "matching.DisparityOptions",
            "Calibration",
            "Camera",
            "geometry.point_cloud.PointCloud",
            "estimate_pose",
            "reconstruct_many",
            "sfm.MultiViewReconstruction",
            "sfm.MultiViewOptions",
        ),
    ),
    ApiPage(
        "api/tracking.md",
        "Tracking",
        "Points followed through a video.",
        (
            "track",
            "tracking.track_frames",
            "tracking.Tracker",
            "tracking.TrackingOptions",
            "tracking.TrackedFrame",
            "tracking.TrackingReport",
            "tracking.FrameSource",
            "tracking.Frame",
            "tracking.load_tracks",
            "tracking.point_candidates",
        ),
    ),
    ApiPage(
        "api/interchange.md",
        "Files of other programs",
        "Keypoints and matches in the file formats of other programs.",
        ("interchange",),
    ),
    ApiPage(
        "api/files.md",
        "Files",
        "Functions that write and read results, never as pickles.",
        ("save_keypoints", "load_keypoints", "save_matches", "load_matches", "save_point_cloud"),
    ),
    ApiPage(
        "api/training.md",
        "Labels, training, evaluation",
        "The masks that the network learns ([labels](../training.md#labels)), and its training "
        "([training](../training.md)), in `deepdetect-lab`.",
        (
            LAB + "labels.fuse",
            LAB + "labels.Label",
            LAB + "labels.LabelOptions",
            LAB + "training.train",
            LAB + "training.TrainingOptions",
            LAB + "evaluation.evaluate",
            LAB + "evaluation.Evaluation",
        ),
    ),
    ApiPage(
        "api/integrations.md",
        "Drop-ins for other programs",
        "Example code: [DeepDetect in other programs](../other-programs.md).",
        (
            "integrations.opencv",
            "integrations.kornia",
            "integrations.lightglue",
            "integrations.hloc",
        ),
    ),
    ApiPage(
        "api/errors.md",
        "Errors",
        "Errors that users can cause are `DeepDetectError`s with a message of one sentence: "
        "[how to catch them](../python.md#errors).",
        (
            "DeepDetectError",
            "ImageError",
            "OptionError",
            "WeightsError",
            "MissingExtraError",
            "ReconstructionError",
            "NoDepthError",
            "RegistrationError",
        ),
    ),
)

# Packages that are not installed have no page.
WHOLE_PACKAGES = {"interchange"}
PAGES = tuple(
    page for page in _PAGES if not WHOLE_PACKAGES & set(page.names) or is_module(page.names[0])
)
