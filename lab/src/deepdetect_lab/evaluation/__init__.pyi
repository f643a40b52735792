from .weights import Evaluation as Evaluation, evaluate as evaluate
