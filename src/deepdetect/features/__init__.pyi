from .keypoints import Keypoints as Keypoints
from .matches import (
    Evidence as Evidence,
    Layer as Layer,
    Matches as Matches,
    TwoViewGeometry as TwoViewGeometry,
)
from .selection import (
    SelectionOptions as SelectionOptions,
    select_keypoints as select_keypoints,
)
from .sift import describe_keypoints as describe_keypoints
