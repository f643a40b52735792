from ._shared.errors import (
    DeepDetectError as DeepDetectError,
    ImageError as ImageError,
    MissingExtraError as MissingExtraError,
    NoDepthError as NoDepthError,
    OptionError as OptionError,
    ReconstructionError as ReconstructionError,
    RegistrationError as RegistrationError,
    WeightsError as WeightsError,
)
from .detector.detector import DeepDetect as DeepDetect
from .detector.point_detector import PointDetector as PointDetector
from .features.keypoints import Keypoints as Keypoints
from .features.matches import Matches as Matches
from .features.selection import SelectionOptions as SelectionOptions
from .geometry.camera import Calibration as Calibration, Camera as Camera
from .geometry.estimation import estimate_geometry as estimate_geometry
from .io.image import load_image as load_image
from .io.point_cloud import save_point_cloud as save_point_cloud
from .io.tables import (
    load_keypoints as load_keypoints,
    load_matches as load_matches,
    save_keypoints as save_keypoints,
    save_matches as save_matches,
)
from .matching.pipeline import match_features as match_features, match_images as match_images
from .matching.refinement import refine_matches as refine_matches
from .matching.registration import register as register
from .matching.stereo.matching import disparity_map as disparity_map
from .matching.stitching import stitch as stitch
from .reconstruction.pipeline import estimate_pose as estimate_pose, reconstruct as reconstruct
from .sfm.pipeline import reconstruct_many as reconstruct_many
from .tracking.pipeline import track as track

__version__: str
