"""Feasibility from distances, by hand; how much f-MDP may train, and where it cannot be."""

from typing import Any

import numpy as np
import pytest

from oodil.pipeline.algorithms.feasibility import adaptive_alpha, feasibility
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.loading import parse_config
from oodil.pipeline.stages.feasibility import training_config
from tests.unit.test_config import values


def test_feasibility_by_hand() -> None:
    found = feasibility(np.array([2.0, 7.0, 12.0, 252.0, 999.0, 1.0]), nearest=2.0, alpha=5.0)
    # Differences of 0, 5 and 10 are 0, 1 and 2 alphas; 250 and 997 are cut at 50 of them; nearer than the nearest is 1.
    np.testing.assert_allclose(found, np.exp([0.0, -1.0, -2.0, -50.0, -50.0, 0.0]), rtol=1e-12)


def test_alpha_is_a_tenth_of_what_separates_the_middle_from_the_nearest() -> None:
    distances = np.array([9.0, 100.0, 3.0, 4.0, 5.0, 6.0, 1.0, 7.0, 8.0, 2.0])
    # Without 1 and 100 the mean of 2 to 9 is 5.5, which is 4.5 from the nearest.
    assert adaptive_alpha(distances) == pytest.approx(0.45)
    assert adaptive_alpha(np.array([4.0, 2.0])) == pytest.approx(0.1)  # too few to leave any out: mean 3


def test_distances_that_are_all_alike_are_all_feasible() -> None:
    alpha = adaptive_alpha(np.full(3, 2.0))
    assert feasibility(np.array([2.0, 2.0, 2.5]), 2.0, alpha).tolist() == [1.0, 1.0, np.exp(-50.0)]


def test_policies_share_the_steps_of_the_clusters_imitators(demonstrations: Any) -> None:
    gail = {"total_steps": 1000, "gae_lambda": 0.9, "policy_optimizer": {"max_kl": 0.02}}
    config = parse_config(
        values(
            clustering={"num_clusters": 3},
            transferability={"gail": gail, "num_trainings": 2},
            f_mdp={"steps_per_iteration": 100},
        ),
        "test",
    )
    tracked = demonstrations(31, 12)
    one, four = training_config(config, tracked, 1), training_config(config, tracked, 4)
    assert (one.total_steps, four.total_steps) == (6000, 1500)
    assert (one.steps_per_rollout, one.simulators_per_group, one.num_groups) == (30, 4, 1)  # 3 episodes are too few
    assert (one.gae_lambda, one.anneal, one.policy_optimizer.kind) == (0.9, False, "trpo")
    assert one.policy_optimizer.max_kl == 0.02


@pytest.mark.parametrize("baseline", ["f_mdp", "f_mdp_per_source"])
@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("Pendulum-v1", r"'Pendulum-v1' cannot be put into an observed state: its class has no method place"),
        ("oodil/Panda20Hz-v0", r"what is observed of environment 'oodil/Panda20Hz-v0' does not tell its state"),
    ],
)
def test_environments_that_cannot_be_placed_are_refused_before_any_work(
    baseline: str, env_id: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=f"^test: baselines: f-MDP: .*{message}"):
        parse_config(values(environment={"id": env_id}, baselines=[baseline]), "test")
