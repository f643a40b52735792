from .pipeline import (
    match_features as match_features,
    match_images as match_images,
)
from .registration import Registration as Registration, register as register
from .stereo import (
    DisparityMap as DisparityMap,
    DisparityOptions as DisparityOptions,
    disparity_map as disparity_map,
)
from .stitching import (
    Panorama as Panorama,
    StitchingOptions as StitchingOptions,
    stitch as stitch,
)
