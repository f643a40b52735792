from .masks import Evaluation as Evaluation, evaluate as evaluate
