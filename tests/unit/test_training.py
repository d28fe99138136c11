"""The loop around the learner: what it refuses, and what it leaves behind."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from oodil.pipeline.algorithms.gail import imitator
from oodil.pipeline.algorithms.learner import EnvReward, Learner
from oodil.pipeline.artifacts import Checkpoints
from oodil.pipeline.collecting import InlineRollouts
from oodil.pipeline.config import EnvironmentConfig, GailConfig, PpoConfig, TrainingConfig, TrpoConfig, ValueConfig
from oodil.pipeline.training import Probe, experience, train


class Context:
    """A job's context that checkpoints every iteration."""

    checkpoint_interval_s = 0.0

    def __init__(self) -> None:
        self.rollouts = InlineRollouts()
        self.reported: list[dict[str, float]] = []

    def progress(self, done: int, total: int, **metrics: float) -> None:
        self.reported.append(metrics)

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


def test_episodes_begin_where_they_are_to(tmp_path: Path) -> None:
    config = TrainingConfig(total_steps=200, num_groups=2, simulators_per_group=2, steps_per_rollout=25)
    start = np.array([[0, 1.25, *[0] * 9, 0.125]], np.float32)
    learner, context = Learner(12, 3, config, EnvReward(), root_seed=0), Context()
    seen: list[NDArray] = []
    submit = context.rollouts.submit
    context.rollouts.submit = lambda units: (seen.extend(u.starts for u in units), submit(units))[1]
    train(learner, EnvironmentConfig(), config, [], context, Checkpoints(tmp_path, {}), starts=start)
    assert len(seen) == 4 and all(each is start for each in seen)
    batch = experience(learner.behavior_policy(), EnvironmentConfig(), config, 25, 0, Context(), starts=start)
    assert (batch.observations[0] == start[0]).all()


@pytest.mark.parametrize(("count", "expected"), [(1, [9]), (2, [7, 9]), (5, [5, 6, 7, 8, 9]), (8, [5, 6, 7, 8, 9])])
def test_probes_of_the_second_half_end_with_the_training(count: int, expected: list[int]) -> None:
    probe = Probe("any", count, lambda: np.zeros(1), second_half=True)
    assert [iteration for iteration in range(10) if probe.is_due(iteration, 10)] == expected
    assert probe.is_due(0, 1)


ALWAYS = {"reward", "policy_lag", "kl", "entropy", "value_loss", "return", "length"}
TRPO = {"improvement", "step_fraction"}
DISCRIMINATOR = {
    "discriminator_loss",
    "discriminator_demonstration_loss",
    "discriminator_policy_loss",
    "discriminator_squared_gradient",
    "demonstration_accuracy",
    "policy_accuracy",
}


@pytest.mark.parametrize("lag", [0, 1])
@pytest.mark.parametrize("imitate", [False, True], ids=["env_reward", "gail"])
@pytest.mark.parametrize("kind", ["trpo", "ppo"])
def test_what_a_training_reports(tmp_path: Path, demonstrations, kind, imitate, lag) -> None:
    """The names are those that metrics.jsonl holds: who renames one breaks what others read."""
    config = GailConfig(
        total_steps=3 * 2 * 2 * 20,
        num_groups=2,
        simulators_per_group=2,
        steps_per_rollout=20,
        lag=lag,
        policy_optimizer=TrpoConfig() if kind == "trpo" else PpoConfig(),
    )
    shown = demonstrations(30, observation_dim=12)
    learner = imitator(12, 3, 9, shown, np.ones(1), config, 0) if imitate else Learner(12, 3, config, EnvReward(), 0)
    context = Context()
    train(learner, EnvironmentConfig(), config, [], context, Checkpoints(tmp_path, {}))
    expected = ALWAYS | (TRPO if kind == "trpo" else set()) | (DISCRIMINATOR if imitate else set())
    assert set(context.reported[-1]) == expected
    assert set().union(*context.reported) == expected
    assert [metrics["policy_lag"] for metrics in context.reported] == [0, lag, lag]
    assert all(np.isfinite(list(metrics.values())).all() for metrics in context.reported)
