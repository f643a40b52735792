from .pipeline import (
    ReconstructionOptions as ReconstructionOptions,
    reconstruct as reconstruct,
)
from .result import Reconstruction as Reconstruction
