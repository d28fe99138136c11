"""The loop around the learner: what it refuses, and what it leaves behind."""

from pathlib import Path

import pytest

from oodil.pipeline.algorithms.learner import EnvReward, Learner
from oodil.pipeline.artifacts import Checkpoints
from oodil.pipeline.collecting import InlineRollouts
from oodil.pipeline.config import EnvironmentConfig, TrainingConfig, ValueConfig
from oodil.pipeline.training import train


class Context:
    """A job's context that checkpoints every iteration."""

    checkpoint_interval_s = 0.0

    def __init__(self) -> None:
        self.rollouts = InlineRollouts()

    def progress(self, done: int, total: int, **metrics: float) -> None: ...

    def warn(self, message: str) -> None: ...

    def should_stop(self) -> bool:
        return False


def test_a_training_that_diverges_names_the_figure_and_leaves_no_checkpoint_of_it(tmp_path: Path) -> None:
    config = TrainingConfig(
        total_steps=200,
        num_groups=1,
        simulators_per_group=2,
        steps_per_rollout=20,
        lag=0,
        value=ValueConfig(learning_rate=1e30),
    )
    learner = Learner(12, 3, config, EnvReward(), root_seed=0)
    checkpoints = Checkpoints(tmp_path, {})
    with pytest.raises(FloatingPointError, match=r"diverged in iteration \d+: .*value_loss.* not finite"):
        train(learner, EnvironmentConfig(), config, [], Context(), checkpoints)
    arrays, _ = checkpoints.load()
    assert arrays is None or all((value == value).all() for value in arrays.values())
