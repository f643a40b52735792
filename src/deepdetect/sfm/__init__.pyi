from .stages import MultiViewOptions as MultiViewOptions
from .pipeline import reconstruct_many as reconstruct_many
from .result import MultiViewReconstruction as MultiViewReconstruction
