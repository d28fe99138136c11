"""Environments that are not ours: the batch is Gymnasium, and a snapshot continues to the same bits."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from oodil.pipeline.environments import check_environment, make_batch
from oodil.pipeline.environments.foreign import ForeignEnvironment
from oodil.pipeline.errors import OodilError

PENDULUM, CAR = "Pendulum-v1", "MountainCarContinuous-v0"
COUNT = 3


def actions_of(batch: Any, steps: int, seed: int = 0) -> np.ndarray:
    return 3 * np.random.default_rng(seed).standard_normal((steps, COUNT, batch.action_dim), dtype=np.float32)


@pytest.mark.parametrize("env_id", [PENDULUM, CAR])
def test_a_batch_is_gymnasium_to_the_bit(env_id: str) -> None:
    batch = make_batch(env_id, {}, COUNT)
    envs = [gymnasium.make(env_id) for _ in range(COUNT)]
    for g, env in enumerate(envs):
        observation, _ = env.reset(seed=g)
        batch.reset(g, seed=g)
        assert batch.observations()[g].tolist() == observation.astype(float).tolist()
    returns = np.zeros(COUNT)
    for action in actions_of(batch, 200):
        outcome = batch.step(action)
        for g, env in enumerate(envs):
            space = env.action_space
            assert isinstance(space, gymnasium.spaces.Box)
            seen = env.step(np.clip(action[g] * space.high, space.low, space.high))
            returns[g] += float(seen[1])
            assert batch.observations()[g].tolist() == seen[0].astype(float).tolist()
            assert (bool(outcome.terminated[g]), bool(outcome.truncated[g])) == (seen[2], seen[3])
    assert outcome.truncated.all() == (env_id == PENDULUM)
    assert batch.episode_returns().tolist() == returns.tolist()


def test_what_has_ended_stays_where_it_is_until_it_is_reset() -> None:
    batch = make_batch(PENDULUM, {}, COUNT)
    for g in range(COUNT):
        batch.reset(g, seed=g)
    actions = actions_of(batch, 210)
    for action in actions[:200]:
        outcome = batch.step(action)
    assert outcome.truncated.all() and not outcome.terminated.any()
    before, returns = batch.observations(), batch.episode_returns()
    batch.reset(1, seed=9)
    outcome = batch.step(actions[200])
    assert outcome.truncated.tolist() == [True, False, True]
    assert batch.observations()[[0, 2]].tobytes() == before[[0, 2]].tobytes()
    assert batch.elapsed_steps().tolist() == [200, 1, 200]
    assert batch.episode_returns()[0] == returns[0]


@pytest.mark.parametrize("env_id", [PENDULUM, CAR])
@pytest.mark.parametrize("fresh", [True, False])
def test_a_snapshot_continues_to_the_same_bits(env_id: str, fresh: bool, assert_same_bits: Any) -> None:
    one = make_batch(env_id, {}, COUNT)
    for g in range(COUNT):
        one.reset(g, seed=g)
    actions = actions_of(one, 60)
    for t, action in enumerate(actions[:30]):
        one.step(action)
        if t == 10:
            one.reset(1, seed=77)
    snapshot = one.snapshot()
    two = make_batch(env_id, {}, COUNT)
    if not fresh:
        for g in range(COUNT):
            two.reset(g, seed=50 + g)
        two.step(actions[40])
    two.restore(snapshot)
    assert_same_bits(two.snapshot(), snapshot)
    for action in actions[30:]:
        assert_same_bits(one.step(action), two.step(action))
        assert one.observations().tobytes() == two.observations().tobytes()


def test_nothing_is_played_again_that_is_there_already(monkeypatch: pytest.MonkeyPatch) -> None:
    batch = make_batch(PENDULUM, {}, COUNT)
    for g in range(COUNT):
        batch.reset(g, seed=g)
    for action in actions_of(batch, 20):
        batch.step(action)
    here = batch.snapshot()
    resets: list[int] = []
    monkeypatch.setattr(ForeignEnvironment, "reset", lambda self, seed: resets.append(seed))
    batch.restore(here)
    assert resets == []


class Random(gymnasium.Env[np.ndarray, np.ndarray]):
    """Draws from somewhere else than its own generator."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return np.zeros(2), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        return np.random.random(2), 0.0, False, False, {}


def test_what_cannot_be_repeated_or_never_ends_is_refused() -> None:
    gymnasium.register("test/Random-v0", entry_point=Random, max_episode_steps=50)
    gymnasium.register("test/Endless-v0", entry_point=Random)
    with pytest.raises(OodilError, match=r"test/Random-v0.*not deterministic.*differed at step 1"):
        check_environment("test/Random-v0", {})
    with pytest.raises(OodilError, match=r"test/Endless-v0.*no time limit"):
        check_environment("test/Endless-v0", {})
    assert check_environment(PENDULUM, {"g": 5.0}).observation_shape == (3,)


class Ball(gymnasium.Env[np.ndarray, np.ndarray]):
    """A ball on a line that is pushed, and that can be placed."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2, 1), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        return self.place(self.np_random.uniform(-1, 1, (2, 1))), {}

    def place(self, observation: np.ndarray) -> np.ndarray:
        assert observation.shape == (2, 1)
        self.state = observation.copy()
        return self.state.copy()

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.state = self.state + 0.1 * np.array([self.state[1], action])
        return self.state.copy(), 1.0, bool(self.state[0] > 2), False, {}


def test_an_environment_with_a_method_for_it_can_be_placed(assert_same_bits: Any) -> None:
    gymnasium.register("test/Ball-v0", entry_point=Ball, max_episode_steps=50)
    assert check_environment("test/Ball-v0", {}).can_be_placed
    batch, other = make_batch("test/Ball-v0", {}, COUNT), make_batch("test/Ball-v0", {}, COUNT)
    for g in range(COUNT):
        batch.reset(g, seed=g)
    actions = actions_of(batch, 60)
    for action in actions[:49]:
        batch.step(action)
    before = batch.snapshot()
    batch.place(1, np.array([0.5, -0.25], np.float32))
    assert batch.observations()[1].tolist() == [0.5, -0.25]
    assert_same_bits(batch.snapshot().states[[0, 2]], before.states[[0, 2]])
    assert batch.elapsed_steps().tolist() == [49, 0, 49] and batch.episode_returns().tolist() == [49, 0, 49]
    for _ in range(2):
        other.restore(batch.snapshot())
        assert_same_bits(other.snapshot(), batch.snapshot())
        for action in actions[49:54]:
            assert_same_bits(other.step(action), batch.step(action))
            assert other.observations().tobytes() == batch.observations().tobytes()
    assert batch.elapsed_steps().tolist() == [50, 10, 50]


def test_an_environment_without_one_is_refused() -> None:
    with pytest.raises(OodilError, match=r"^environment 'Pendulum-v1' cannot be put into an observed state: .*place"):
        make_batch(PENDULUM, {}, 1).place(0, np.zeros(3))
    assert not check_environment(PENDULUM, {}).can_be_placed


def test_a_snapshot_of_another_size_is_refused() -> None:
    small, large = make_batch(PENDULUM, {}, 1), make_batch(PENDULUM, {}, 2)
    with pytest.raises(ValueError, match=r"snapshot holds 1 histories; this batch has 2"):
        large.restore(small.snapshot())
