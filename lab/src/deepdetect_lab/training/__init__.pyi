from .recipe import (
    PRESETS as PRESETS,
    DescriptorTrainingOptions as DescriptorTrainingOptions,
    DeviceOptions as DeviceOptions,
    MatcherTrainingOptions as MatcherTrainingOptions,
    MatchFilterTrainingOptions as MatchFilterTrainingOptions,
    PointsTrainingOptions as PointsTrainingOptions,
    Stage as Stage,
    TrainingOptions as TrainingOptions,
)
from .run import (
    train as train,
    train_on_pairs as train_on_pairs,
)
from .trainer import TrainingResult as TrainingResult
