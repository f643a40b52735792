from .outliers import PointFilterOptions as PointFilterOptions
from .pipeline import reconstruct as reconstruct
from .result import Reconstruction as Reconstruction
