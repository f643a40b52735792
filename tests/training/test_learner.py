from __future__ import annotations

import math

import pytest

torch = pytest.importorskip("torch", reason="needs torch, which is for training only")

from deepdetect import OptionError  # noqa: E402
from deepdetect.detector.network.espnet import ESPNet  # noqa: E402
from deepdetect.training.learner import Learner  # noqa: E402
from deepdetect.training.recipe import DeviceOptions, TrainingOptions  # noqa: E402

PLAIN = DeviceOptions("cpu", "float32", compile=False, threads=1)


class Constant(torch.nn.Module):
    """A network that knows nothing but how much is marked."""

    def __init__(self) -> None:
        super().__init__()
        self.logit = torch.nn.Parameter(torch.zeros(()))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.logit.expand(len(image), 1, *image.shape[2:])


@pytest.mark.parametrize("weight", [1.0, 1.3, 0.5])
def test_a_marked_pixel_counts_by_its_weight(weight: float) -> None:
    """The least loss of a constant is at the odds of the marked pixels times the weight."""
    learner = Learner(Constant(), PLAIN, TrainingOptions(pos_weight=weight))
    rgb = torch.zeros((2, 16, 16, 3), dtype=torch.uint8)
    masks = torch.zeros((2, 16, 16), dtype=torch.bool)
    masks[:, :4] = True
    first = learner.training_step(rgb, masks, 0.05, 0)
    assert first == pytest.approx(math.log(2) * (0.75 + 0.25 * weight), rel=1e-5)
    for step in range(1, 300):
        learner.training_step(rgb, masks, 0.05 * (1 - step / 300), step)
    assert learner.network.logit.item() == pytest.approx(math.log(weight / 3), abs=0.01)


@pytest.mark.parametrize(("marked_rows", "weight"), [(4, 3.0), (4, 1.5), (1, 3.0), (12, 2.0)])
def test_only_doubtful_marks_may_count_more(marked_rows: int, weight: float) -> None:
    """The least loss is where odds are those of the marked pixels times the weight *there*."""
    learner = Learner(
        Constant(), PLAIN, TrainingOptions(pos_weight=weight, pos_weight_uncertain=True)
    )
    rgb = torch.zeros((2, 16, 16, 3), dtype=torch.uint8)
    masks = torch.zeros((2, 16, 16), dtype=torch.bool)
    masks[:, :marked_rows] = True
    share = marked_rows / 16
    first = learner.training_step(rgb, masks, 0.05, 0)
    assert first == pytest.approx(math.log(2) * (1 - share + share * weight), rel=1e-5)
    for step in range(1, 400):
        learner.training_step(rgb, masks, 0.05 * (1 - step / 400), step)
    logit = learner.network.logit.item()
    probability = 1 / (1 + math.exp(-logit))
    there = 1 + (weight - 1) * 4 * probability * (1 - probability)
    assert logit == pytest.approx(math.log(there * share / (1 - share)), abs=0.01)
    assert there <= weight


def test_dark_images_have_a_weight_of_their_own() -> None:
    """Half of the crops are dark: the first loss is the mean of both kinds."""
    learner = Learner(Constant(), PLAIN, TrainingOptions(pos_weight=3.0, low_light_pos_weight=1.0))
    rgb = torch.zeros((2, 16, 16, 3), dtype=torch.uint8)
    rgb[:, 8:] = torch.tensor([200, 40], dtype=torch.uint8)[
        :, None, None, None
    ]  # grey levels spanned
    masks = torch.zeros((2, 16, 16), dtype=torch.bool)
    masks[0, :8] = True
    only_in_normal = learner.training_step(rgb, masks, 0.0, 0)
    assert only_in_normal == pytest.approx(math.log(2) * (2.0 + 1.0) / 2, rel=1e-5)
    only_in_dark = learner.training_step(rgb, masks.flip(0), 0.0, 1)
    assert only_in_dark == pytest.approx(math.log(2), rel=1e-5)


def test_a_loss_that_is_not_finite_is_an_error() -> None:
    learner = Learner(Constant(), PLAIN, TrainingOptions())
    with torch.no_grad():
        learner.network.logit.fill_(float("inf"))
    rgb = torch.zeros((1, 16, 16, 3), dtype=torch.uint8)
    masks = torch.zeros((1, 16, 16), dtype=torch.bool)
    with pytest.raises(OptionError, match=r"not finite at step 7: .*`learning_rate`"):
        learner.training_step(rgb, masks, 0.1, 7)


def test_scores_of_images_of_any_size() -> None:
    learner = Learner(Constant(), PLAIN, TrainingOptions())
    sizes = [(16, 16), (21, 30)]
    pairs = [
        (torch.zeros((*size, 3), dtype=torch.uint8), torch.ones(size, dtype=torch.bool))
        for size in sizes
    ]
    learner.network.train()
    scores = learner.score(pairs)
    assert [score.loss for score in scores] == pytest.approx([math.log(2)] * 2)
    assert learner.network.training


@pytest.mark.parametrize("frozen_batch_norm", [False, True])
def test_a_frozen_encoder_stays_as_it_is(frozen_batch_norm: bool) -> None:
    torch.manual_seed(0)
    network = ESPNet()
    before = {name: value.clone() for name, value in network.state_dict().items()}
    options = TrainingOptions(freeze_encoder=True, frozen_batch_norm=frozen_batch_norm)
    learner = Learner(network, PLAIN, options)
    rgb = torch.randint(0, 256, (2, 32, 32, 3), dtype=torch.uint8)
    learner.training_step(rgb, rgb[..., 0] > 128, 1e-3, 0)
    changed = {
        name for name, value in network.state_dict().items() if (value != before[name]).any()
    }
    assert not any(name.startswith("encoder.") for name in changed)
    assert len([name for name in changed if name.endswith("weight")]) > 10
    assert frozen_batch_norm != any("running" in name for name in changed)
