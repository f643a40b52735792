from .outliers import PointFilterOptions as PointFilterOptions
from .pipeline import estimate_pose as estimate_pose, reconstruct as reconstruct
from .result import Reconstruction as Reconstruction
