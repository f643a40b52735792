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
from .detector.heatmap import HeatmapOptions as HeatmapOptions
from .evaluation.evaluate import Evaluation as Evaluation, evaluate as evaluate
from .features.keypoints import Keypoints as Keypoints
from .features.selection import (
    SelectionOptions as SelectionOptions,
    select_keypoints as select_keypoints,
)
from .features.matches import TwoViewGeometry as TwoViewGeometry, Matches as Matches
from .geometry.camera import Calibration as Calibration, Camera as Camera
from .geometry.estimation import (
    Geometry as Geometry,
    GeometryOptions as GeometryOptions,
    estimate_geometry as estimate_geometry,
)
from .geometry.point_cloud import PointCloud as PointCloud
from .io.image import load_image as load_image
from .io.point_cloud import save_point_cloud as save_point_cloud
from .io.tables import (
    load_keypoints as load_keypoints,
    load_matches as load_matches,
    save_keypoints as save_keypoints,
    save_matches as save_matches,
)
from .labels import Label as Label, LabelOptions as LabelOptions, fuse as fuse
from .matching.options import (
    PUBLISHED_MATCHING as PUBLISHED_MATCHING,
    MatchingOptions as MatchingOptions,
)
from .matching.pipeline import match_images as match_images
from .matching.unguided import match_features as match_features
from .matching.registration import Registration as Registration, register as register
from .matching.stitching import (
    Panorama as Panorama,
    StitchingOptions as StitchingOptions,
    stitch as stitch,
)
from .reconstruction.pipeline import (
    ReconstructionOptions as ReconstructionOptions,
    reconstruct as reconstruct,
)
from .reconstruction.result import Reconstruction as Reconstruction
from .matching.stereo.matching import (
    DisparityMap as DisparityMap,
    DisparityOptions as DisparityOptions,
    disparity_map as disparity_map,
)
from .sfm.options import MultiViewOptions as MultiViewOptions
from .sfm.pipeline import reconstruct_many as reconstruct_many
from .sfm.result import MultiViewReconstruction as MultiViewReconstruction
from .training.recipe import TrainingOptions as TrainingOptions
from .training.run import train as train

__version__: str
