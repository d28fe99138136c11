"""What a simulator can follow, where the answer is known: a cart that pushes half as hard as some demonstrators."""

from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest

from oodil.pipeline.artifacts import write_artifact
from oodil.pipeline.data import Demonstrations, Episode
from oodil.pipeline.environments import environment_spec, make_batch
from oodil.pipeline.errors import ConfigError
from oodil.pipeline.loading import parse_config
from oodil.pipeline.reproducibility import Follower, deviations, distances
from oodil.pipeline.results import Reproducibility
from tests.unit.test_config import values

CART, HOPPER = "test/Cart-v0", "oodil/Hopper-v0"
STEP = 0.1


class Cart(gymnasium.Env[np.ndarray, np.ndarray]):
    """Position, velocity, and a number that never changes; an action is an acceleration between -2 and 0.5."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (3,), np.float64)
    action_space = gymnasium.spaces.Box(-2.0, 0.5, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self.place(np.array([*self.np_random.uniform(-1, 1, 2), 7.0])), {}

    def place(self, observation: np.ndarray) -> np.ndarray:
        self.state = observation.copy()
        return self.state.copy()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.state = moved(self.state, float(action[0]))
        return self.state.copy(), float("nan"), False, False, {}


gymnasium.register(CART, entry_point=Cart, max_episode_steps=100)


def moved(state: np.ndarray, acceleration: float) -> np.ndarray:
    position, velocity, constant = state
    return np.array([position + STEP * velocity, velocity + STEP * acceleration, constant])


def driven(*accelerations: float, steps: int = 20) -> Demonstrations:
    """Return a demonstration, and source, of each acceleration."""
    parts = []
    for acceleration in accelerations:
        states = [np.array([0.0, 0.5, 7.0])]
        for _ in range(steps):
            states.append(moved(states[-1], acceleration))
        parts.append(Demonstrations.of([Episode(np.array(states))], f"at {acceleration:g}"))
    return Demonstrations.joined(parts)


def followed(demonstrations: Demonstrations, horizon: int = 3, env_id: str = CART, simulators: int = 4) -> np.ndarray:
    """Return (N, 2, 5) residuals of five trials."""
    follower = Follower(make_batch(env_id, {}, simulators), environment_spec(env_id, {}), 6)

    def units(steps: int) -> np.ndarray:
        return deviations(demonstrations, steps)

    found = [
        follower.residuals(demonstrations[n].astype(np.float64), 5, horizon, units, np.random.default_rng(n))
        for n in range(len(demonstrations))
    ]
    assert follower.env_steps % simulators == 0 and follower.env_steps > 0
    return np.stack(found)


def test_distances_are_counted_in_deviations_of_what_changes() -> None:
    demonstrations = driven(-1.0, 0.5, 1.0)
    for steps in (1, 3):
        changes = np.concatenate([demonstrations[n][steps:] - demonstrations[n][:-steps] for n in range(3)])
        units = deviations(demonstrations, steps)
        np.testing.assert_allclose(units[:2], changes.astype(np.float64).std(axis=0)[:2], rtol=1e-4)
        assert units[2] == np.inf
    away = np.array([[2 * units[0], 0.0, 99.0]])
    assert distances(away, np.zeros((1, 3)), units) == pytest.approx(2 / np.sqrt(2))


@pytest.mark.parametrize("horizon", [1, 3])
def test_residuals_are_what_the_bounds_of_the_actions_leave(horizon: int) -> None:
    """A push of 1 that is answered by 0.5 leaves the velocity behind, more in each step, and the position after it."""
    demonstrations = driven(-1.0, 0.5, 1.0, -3.0)
    found = followed(demonstrations, horizon)
    assert found.shape == (4, 2, 5)
    assert (found[:2] < 2e-3).all()
    for n, short in ((2, 0.5), (3, 1.0)):
        for row, steps in ((0, 1), (1, horizon)):
            slower, behind = STEP * short * steps, STEP**2 * short * steps * (steps - 1) / 2
            units = deviations(demonstrations, steps)
            expected = np.sqrt(((slower / units[1]) ** 2 + (behind / units[0]) ** 2) / 2)
            np.testing.assert_allclose(found[n, row], expected, rtol=2e-3)


def test_short_demonstrations_are_followed_to_their_end() -> None:
    demonstrations = Demonstrations.joined([driven(1.0, steps=2), driven(-1.0)])
    short = followed(demonstrations, horizon=9)[0]
    units = deviations(demonstrations, 2)
    expected = np.sqrt(((STEP / units[1]) ** 2 + (STEP**2 / 2 / units[0]) ** 2) / 2)
    np.testing.assert_allclose(short[1], expected, rtol=2e-3)


def hops(count: int) -> Demonstrations:
    simulators = make_batch(HOPPER, {"gravity": 3.0}, count)
    rng = np.random.default_rng(0)
    for g in range(count):
        simulators.reset(g, seed=g)
    states = [simulators.observations()]
    for _ in range(30):
        simulators.step(rng.uniform(-1, 1, (count, 3)))
        states.append(simulators.observations())
    return Demonstrations.of([Episode(each) for each in np.stack(states, axis=1)], "hops")


def test_the_number_of_simulators_changes_no_bit(assert_same_bits: Any) -> None:
    demonstrations = hops(3)
    one = followed(demonstrations, 2, HOPPER, 1)
    assert (one[:, 0] > 0.02).any()
    assert_same_bits(one, followed(demonstrations, 2, HOPPER, 7))


def test_where_no_state_tells_the_simulator_nothing_is_known() -> None:
    states = np.zeros((5, 12))
    states[:, 6:] = 10.0
    states[:, 0] = np.arange(5)
    demonstrations = Demonstrations.joined([hops(1), Demonstrations.of([Episode(states)], "clipped")])
    found = followed(demonstrations, 2, HOPPER)
    assert np.isfinite(found[0]).all() and np.isnan(found[1]).all()
    known = Reproducibility(found[:, 0], found[:, 1])
    assert known.reproducible_sources(demonstrations) == [known.by_source(demonstrations)[0] <= 0.05, False]


def test_a_source_is_reproducible_if_three_of_four_trials_are(tmp_path: Any, assert_same_bits: Any) -> None:
    demonstrations = driven(0.0, 1.0, 2.0)
    one_step = np.array([[0.0, 0.04, 0.04, 0.9], [0.0, 0.0, 0.06, 0.06], [0.01, np.nan, np.nan, np.nan]])
    found = Reproducibility(one_step, 2 * one_step, 12)
    assert found.reproducible_sources(demonstrations) == [False, False, True]
    one_step[0, 3] = 0.04
    assert found.reproducible_sources(demonstrations) == [True, False, True]
    same = replace(demonstrations, source_labels=("one", "one", "other"))
    assert found.by_source(same) == found.by_source(demonstrations), "two sources may have one name"
    assert found.mean()[1] == 0.03 and found.horizon_mean()[1] == 0.06
    assert found.median()[1] == 0.03
    assert_same_bits(Reproducibility.load(write_artifact(tmp_path / "a", {}, found.files())), found)
    assert Reproducibility.joined([found, found]).one_step.shape == (6, 4)


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("Pendulum-v1", r"'Pendulum-v1' cannot be put into an observed state: its class has no method place"),
        ("oodil/Panda20Hz-v0", r"what is observed of environment 'oodil/Panda20Hz-v0' does not tell its state"),
    ],
)
def test_environments_that_cannot_be_placed_are_refused_before_any_work(env_id: str, message: str) -> None:
    with pytest.raises(ConfigError, match=f"^test: reproducibility: .*{message}"):
        parse_config(values(environment={"id": env_id}, reproducibility={}), "test")
    parse_config(values(environment={"id": env_id}), "test")
