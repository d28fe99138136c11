"""The inverse model of ID, what it is learned from, how it follows, and what its errors score."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from oodil.pipeline.algorithms.inverse_dynamics import Exploration, InverseModel, error_bounds
from oodil.pipeline.artifacts import write_artifact
from oodil.pipeline.config import InverseDynamicsConfig
from oodil.pipeline.data import Demonstrations, Episode, TransitionBatch
from oodil.pipeline.environments import make_batch
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.following import ModelFollower
from oodil.pipeline.loading import parse_config
from oodil.pipeline.results import Following
from oodil.pipeline.stages.inverse_dynamics import judged
from tests.unit.test_config import values

PUSHED, HOPPER = "test/Pushed-v0", "oodil/Hopper-v0"
KEY = (0, 1)
BOUNDS = np.full(2, -1, np.float32), np.full(2, 1, np.float32)
MIXING = np.array([[0.5, 0.2], [-0.1, 0.4]])
"""A linear system: s' = 0.9 s + MIXING a."""


class Pushed(gymnasium.Env[np.ndarray, np.ndarray]):
    """The linear system."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self.place(np.zeros(2)), {}

    def place(self, observation: np.ndarray) -> np.ndarray:
        self.state = observation.copy()
        return self.state.copy()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.state = 0.9 * self.state + MIXING @ action
        return self.state.copy(), 0.0, False, False, {}


gymnasium.register(PUSHED, entry_point=Pushed, max_episode_steps=100)


class Constant:
    """A model that always wants the same action."""

    def __init__(self, *action: float) -> None:
        self._action = np.array(action, np.float32)

    def act(self, states: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        return np.tile(self._action, (len(states), 1))


def shown(*episodes: list[list[float]]) -> Demonstrations:
    return Demonstrations.of([Episode(np.array(states)) for states in episodes], "shown")


def explored(count: int = 4000) -> Exploration:
    """Return transitions of the linear system under random actions."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(0, 1, (count, 2)), rng.uniform(-1, 1, (count, 2))
    after = 0.9 * states + actions @ MIXING.T
    narrow = [each.astype(np.float32) for each in (states, after, actions)]
    return Exploration(*narrow, held_out=shown([[0, 0], [0, 0]]))


def learned(config: InverseDynamicsConfig, passes: int, observation_dim: int = 2) -> InverseModel:
    model = InverseModel(observation_dim, 2, config, KEY)
    for number in range(passes):
        model.learn(explored(), number)
    return model


def test_errors_are_summed_distances_over_the_number_of_states() -> None:
    """Placed at (1, 0), the action (1, 0), which 2 is clipped to, leads to (1.4, -0.1) and then to (1.76, -0.19)."""
    demonstrations = shown([[1, 0], [1.4, 0.2], [1.76, -0.19]], [[0, 0], [0.5, -0.1]])
    for simulators in (1, 2, 5):
        follower = ModelFollower(make_batch(PUSHED, {}, simulators), BOUNDS, Constant(2.0, 0.0))  # type: ignore[arg-type]
        np.testing.assert_allclose(follower.errors(demonstrations), [0.3 / 3, 0.0], atol=1e-7)


def test_scores_fall_linearly_between_the_bounds() -> None:
    errors, held_out = np.array([0.1, 0.2, 0.3, 0.5, 9.0]), np.array([0.2, 0.6, 0.3])
    assert error_bounds(errors, held_out) == (0.2, 0.6)
    found = Following(errors, 0.2, 0.6)
    np.testing.assert_allclose(found.scores(errors), [1, 1, 0.75, 0.25, 0], atol=1e-12)
    np.testing.assert_allclose(judged(found, errors).weights, np.array([1, 1, 0.75, 0.25, 0]) / 3)
    assert judged(found, errors).verdicts.tolist() == ["kept"] * 4 + ["not kept"]
    assert error_bounds(errors + 0.6, held_out) == (0.2, 9.6), "all are above, so the worst of them is the bound"


def test_where_nothing_or_everything_scores_zero_no_one_is_preferred() -> None:
    found = Following(np.array([2.0, np.inf]), 1.0, 1.0)
    assert found.scores(np.array([1.0, 1.0 + 1e-9])).tolist() == [1, 0]
    assert judged(found, found.errors).weights.tolist() == [0.5, 0.5]
    assert set(judged(found, found.errors).verdicts) == {"not kept"}, "both are beyond the bound"


def test_what_was_found_reads_back(tmp_path: Path, assert_same_bits: Any) -> None:
    found = Following(np.array([1.0, 2.0]), 0.5, 1.5, InverseModel(2, 2, InverseDynamicsConfig(), KEY).arrays())
    assert_same_bits(Following.load(write_artifact(tmp_path / "a", {}, found.files())), found)


def test_the_network_is_made_of_residual_blocks() -> None:
    model = InverseModel(3, 2, InverseDynamicsConfig(hidden=5, blocks=2), KEY)
    arrays = {name: value.astype(np.float64) for name, value in model.arrays().items()}
    states, wanted = np.random.default_rng(0).normal(size=(2, 4, 3))

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        return x @ arrays[f"{name}.weight"].T + arrays[f"{name}.bias"]

    hidden = np.maximum(linear("first", np.concatenate((states, wanted - states), axis=1)), 0)
    for block in range(2):
        hidden = np.maximum(hidden + np.maximum(linear(f"blocks.{block}", hidden), 0), 0)
    np.testing.assert_allclose(model.act(states, wanted), linear("last", hidden), rtol=1e-4, atol=1e-6)
    inputs = torch.from_numpy(np.concatenate((states, wanted - states), axis=1).astype(np.float32))
    np.testing.assert_allclose(model(inputs).detach(), model.act(states, wanted), rtol=1e-4, atol=1e-6)
    defaults = InverseModel(3, 2, InverseDynamicsConfig(), KEY)
    assert (len(defaults.blocks), defaults.first.out_features) == (6, 100)


def test_a_linear_system_is_inverted_and_followed() -> None:
    model = learned(InverseDynamicsConfig(hidden=32, blocks=2, learning_rate=3e-3), 30)
    exploration = explored(200)
    actions = model.act(exploration.states.astype(np.float64), exploration.next_states.astype(np.float64))
    assert np.abs(actions - exploration.actions).mean() < 0.03
    rng = np.random.default_rng(1)
    states = [np.zeros(2)]
    for _ in range(30):
        states.append(0.9 * states[-1] + MIXING @ rng.uniform(-1, 1, 2))
    far = [[0.0, 0.0], *([3.0, 3.0] for _ in range(30))]
    near, lost = ModelFollower(make_batch(PUSHED, {}, 2), BOUNDS, model).errors(
        shown([s.tolist() for s in states], far)
    )
    assert near < 0.05 < 0.5 < lost


def test_a_seed_gives_the_same_bits_also_when_it_goes_on_from_a_checkpoint(assert_same_bits: Any) -> None:
    config = InverseDynamicsConfig(hidden=16, blocks=1)
    whole, half = learned(config, 2), learned(config, 1)
    resumed = InverseModel(2, 2, config, KEY)
    resumed.load({name: value.copy() for name, value in half.arrays().items()})
    resumed.load_moments({name: value.copy() for name, value in half.moments().items()})
    resumed.learn(explored(), 1)
    assert_same_bits(resumed.arrays(), whole.arrays())
    assert_same_bits(resumed.moments(), whole.moments())
    other = InverseModel(2, 2, config, (0, 2)).arrays()["first.weight"]
    assert (other != InverseModel(2, 2, config, KEY).arrays()["first.weight"]).any()


def test_the_number_of_simulators_changes_no_bit(assert_same_bits: Any) -> None:
    model = InverseModel(12, 3, InverseDynamicsConfig(hidden=9), KEY)
    simulators = make_batch(HOPPER, {}, 7)
    states = []
    for g in range(7):
        simulators.reset(g, g)
    for t in range(40):
        simulators.step(np.full((7, 3), np.sin(t)))
        states.append(simulators.observations())
    demonstrations = Demonstrations.of([Episode(each[: 10 + 5 * g]) for g, each in enumerate(np.stack(states, 1))], "")
    bounds = np.full(3, -1, np.float32), np.full(3, 1, np.float32)
    one, *others = (ModelFollower(make_batch(HOPPER, {}, g), bounds, model).errors(demonstrations) for g in (1, 3, 20))
    assert (one > 0).all()
    for other in others:
        assert_same_bits(other, one)


def batch_of(ended: np.ndarray, rollout: Any) -> TransitionBatch:
    """Return experience that ends where (T, G) says, of states that tell their simulator and time."""
    made = rollout(0, *ended.shape, observation_dim=2)
    time, simulator = np.mgrid[: ended.shape[0], : ended.shape[1]]
    states = np.stack((simulator, time), axis=-1).astype(np.float32)
    after = states + np.array([0, 0.5], np.float32)
    made = replace(made, observations=states, next_observations=after, actions=5 * made.actions, truncated=ended)
    return TransitionBatch.of([replace(made, terminated=np.zeros_like(ended))])


def test_whole_episodes_are_held_out(rollout: Any) -> None:
    ended = np.zeros((10, 3), np.bool_)
    ended[[3, 7, 4, 9], [0, 0, 1, 2]] = True
    found = Exploration.of(batch_of(ended, rollout), BOUNDS, 0.4, KEY)
    held = {(int(e[0, 0]), int(e[0, 1]), len(e) - 1) for e in (found.held_out[n] for n in range(len(found.held_out)))}
    assert held < {(0, 0, 4), (0, 4, 4), (1, 0, 5), (2, 0, 10)}, "not what was broken off"
    count = sum(length for _, _, length in held)
    assert count >= 12 > count - max(length for _, _, length in held)
    assert len(found.states) == 30 - count
    seen = {(int(g), int(t)) for g, t in found.states}
    assert not seen & {(g, begin + t) for g, begin, length in held for t in range(length)}
    np.testing.assert_array_equal(found.next_states - found.states, np.tile((0, 0.5), (30 - count, 1)))
    assert np.abs(found.actions).max() == 1
    for n in range(len(found.held_out)):
        steps = found.held_out[n][:, 1] - found.held_out[n][0, 1]
        np.testing.assert_array_equal(steps[1:], np.arange(len(steps) - 1) + 0.5)


def test_where_no_episode_ends_one_that_is_broken_off_is_held_out(rollout: Any) -> None:
    found = Exploration.of(batch_of(np.zeros((10, 2), np.bool_), rollout), BOUNDS, 0.99, KEY)
    assert (len(found.held_out), len(found.states)) == (1, 10)


def test_a_model_that_diverges_says_so() -> None:
    model = InverseModel(2, 2, InverseDynamicsConfig(learning_rate=1e30), KEY)
    with pytest.raises(FloatingPointError, match="inverse model diverged in pass 1: its loss is nan"):
        model.learn(explored(500), 0)


@pytest.mark.parametrize(("baseline", "said"), [("id_random", "ID without GAIL"), ("id_gail", "ID with GAIL")])
def test_environments_that_cannot_be_placed_are_refused_before_any_work(baseline: str, said: str) -> None:
    message = f"test: baselines: {said} follows demonstrations; environment 'Pendulum-v1' cannot be put into"
    with pytest.raises(ConfigError, match=message):
        parse_config(values(environment={"id": "Pendulum-v1"}, baselines=[baseline]), "test")


def test_exact_id_needs_a_state_that_is_observed() -> None:
    with pytest.raises(ConfigError, match=r"what is observed of environment .* does not tell its state"):
        parse_config(values(environment={"id": "oodil/Panda20Hz-v0"}, baselines=["exact_id"]), "test")
    parse_config(values(environment={"id": "oodil/Panda20Hz-v0"}, baselines=["id_random"]), "test")
