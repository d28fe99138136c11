"""Any deterministic Gymnasium environment, its inner state unknown: a snapshot is a start and the actions since.

Restoring plays an episode again from its start. That is as slow as it sounds, so a batch that stands where it is asked
to go does nothing; workers keep one batch per env group, and a group tends to stay with its worker.

Letters: G simulators, S observation, A action, H steps of the longest episode.
"""

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Snapshot
from oodil.pipeline.environments.batch import StepOutcome
from oodil.pipeline.environments.pictures import checked, follow
from oodil.pipeline.errors import UnusableEnvironmentError

STEPS_PER_SECOND = 30
"""Of a film of an environment that does not say how fast it is."""
_TRIAL_STEPS = 20


def box_spaces(env: gymnasium.Env[Any, Any]) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return observation and action space. Raises ValueError unless both are boxes."""
    seen, action = env.observation_space, env.action_space
    for what, space in (("observation", seen), ("action", action)):
        if not isinstance(space, gymnasium.spaces.Box):
            raise ValueError(f"the {what} space is {space}; only Box spaces can be used")
    assert isinstance(seen, gymnasium.spaces.Box) and isinstance(action, gymnasium.spaces.Box)
    return seen, action


def can_be_placed(env: gymnasium.Env[Any, Any]) -> bool:
    """Return whether an environment has a method ``place(observation)``, which returns what it then observes."""
    return hasattr(env.unwrapped, "place")


def unplaceable(env_id: str) -> str:
    """Say that an environment cannot be placed."""
    return f"environment {env_id!r} cannot be put into an observed state: its class has no method place(observation)"


class ReplayBatch:
    """G Gymnasium environments side by side; the caller decides when an ended one is reset.

    An environment that has ended stays where it is, whatever its action, until it is reset.
    """

    def __init__(self, environments: list[gymnasium.Env[Any, Any]], max_episode_steps: int) -> None:
        """Take over environments of one kind. Raises ValueError unless both spaces are boxes."""
        self._environments = environments
        self.num_simulators = len(environments)
        self.max_episode_steps = max_episode_steps
        seen, action = box_spaces(environments[0])
        self._actions = action
        self.observation_dim = int(np.prod(seen.shape))
        self.action_dim = int(np.prod(action.shape))
        self._observations = np.zeros((self.num_simulators, self.observation_dim))
        # A row is a seed and then every action since, as far as there are any. One that can be placed has room in
        # between for where it was placed; its seed is -1 then.
        self._before_actions = 1 + self.observation_dim * can_be_placed(environments[0])
        self._history = np.zeros((self.num_simulators, self._before_actions + max_episode_steps * self.action_dim))
        self._elapsed = np.zeros(self.num_simulators, np.int64)
        self._returns = np.zeros(self.num_simulators)
        self._terminated = np.zeros(self.num_simulators, np.bool_)
        self._truncated = np.ones(self.num_simulators, np.bool_)
        self.steps_per_second = float(environments[0].metadata.get("render_fps") or STEPS_PER_SECOND)
        for env in environments:
            if hasattr(env.unwrapped, "mujoco_renderer"):
                follow(env.unwrapped.mujoco_renderer)

    def observations(self) -> NDArray[np.float64]:
        """Return (G, S) observations of the present states, flattened."""
        return self._observations.copy()

    def reset(self, simulator: int, seed: int) -> None:
        """Start a new episode in one environment with a seed of at most 2**53."""
        observation, _ = self._environments[simulator].reset(seed=seed)
        self._begin(simulator, observation)
        self._history[simulator, 0] = seed

    def place(self, simulator: int, observation: NDArray[np.floating]) -> None:
        """Start a new episode in one environment, put where (S,) is observed by its own method ``place``.

        Raises UnusableEnvironmentError if it has none.
        """
        env = self._environments[simulator]
        if not can_be_placed(env):
            raise UnusableEnvironmentError(unplaceable(env.spec.id if env.spec is not None else str(env.unwrapped)))
        env.reset(seed=0)  # Wrappers count an episode's steps from its reset.
        task: Any = env.unwrapped
        wanted = observation.astype(np.float64)
        self._begin(simulator, task.place(wanted.reshape(env.observation_space.shape or ())))
        self._history[simulator, 0] = -1
        self._history[simulator, 1 : self._before_actions] = wanted

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) that all do: an environment with a method ``place`` says so by having it."""
        return np.ones(len(observations), np.bool_)

    def _begin(self, simulator: int, observation: Any) -> None:
        self._observations[simulator] = np.asarray(observation, np.float64).ravel()
        self._history[simulator] = 0
        self._elapsed[simulator] = 0
        self._returns[simulator] = 0.0
        self._terminated[simulator] = self._truncated[simulator] = False

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions, clipped to the action space, in every environment that has not ended."""
        rewards = np.zeros(self.num_simulators)
        for i in np.flatnonzero(~(self._terminated | self._truncated)).tolist():
            rewards[i] = self._advance(i, actions[i].astype(np.float32))
        return StepOutcome(rewards, self._terminated.copy(), self._truncated.copy())

    def elapsed_steps(self) -> NDArray[np.int64]:
        """Return (G,) steps since the last reset of each environment."""
        return self._elapsed.copy()

    def episode_returns(self) -> NDArray[np.float64]:
        """Return (G,) sums of the environment's own reward since the last reset; for evaluation only."""
        return self._returns.copy()

    def snapshot(self) -> Snapshot:
        """Save all environments; `restore` continues from here to the same bits."""
        return Snapshot(self._history.copy(), self._elapsed.copy(), self._returns.copy())

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of a batch of the same size, playing again what is not there yet."""
        if snapshot.states.shape != self._history.shape:
            raise ValueError(
                f"snapshot holds histories of shape {snapshot.states.shape}; this batch needs {self._history.shape}"
            )
        for i, (history, elapsed) in enumerate(zip(snapshot.states, snapshot.elapsed_steps.tolist(), strict=True)):
            if elapsed == self._elapsed[i] and history.tobytes() == self._history[i].tobytes():
                continue
            if history[0] < 0:
                self.place(i, history[1 : self._before_actions])
            else:
                self.reset(i, seed=int(history[0]))
            for action in history[self._before_actions :].reshape(-1, self.action_dim)[:elapsed]:
                self._advance(i, action.astype(np.float32))

    def render(self, simulator: int) -> NDArray[np.uint8]:
        """Return what an environment draws (height, width, 3). Raises TypeError if that is no picture."""
        return checked(self._environments[simulator].render())

    def close(self) -> None:
        """Close the environments."""
        for env in self._environments:
            env.close()

    def _advance(self, simulator: int, action: NDArray[np.float32]) -> float:
        elapsed = int(self._elapsed[simulator])
        begin = self._before_actions + elapsed * self.action_dim
        self._history[simulator, begin : begin + self.action_dim] = action
        space = self._actions
        clipped = np.clip(action.reshape(space.shape), space.low, space.high).astype(space.dtype)
        observation, reward, terminated, truncated, _ = self._environments[simulator].step(clipped)
        seen = np.asarray(observation, np.float64).ravel()
        if not np.isfinite(seen).all():
            raise FloatingPointError(f"step {elapsed + 1} of an episode gave an observation that is not finite: {seen}")
        self._observations[simulator] = seen
        self._elapsed[simulator] += 1
        self._returns[simulator] += float(reward)
        self._terminated[simulator] = terminated
        self._truncated[simulator] = truncated or elapsed + 1 >= self.max_episode_steps
        return float(reward)


def refuse_randomness(batch: ReplayBatch, env_id: str) -> None:
    """Raise UnusableEnvironmentError if the same seed and actions can lead to different states."""
    rng = np.random.default_rng(0)
    actions = rng.standard_normal((_TRIAL_STEPS, 1, batch.action_dim), dtype=np.float32)
    traces = []
    for _ in range(2):
        batch.reset(0, seed=1)
        trace = [batch.observations()[:1]]
        for action in actions:
            batch.step(np.repeat(action, batch.num_simulators, axis=0))
            trace.append(batch.observations()[:1])
        traces.append(np.concatenate(trace))
    if traces[0].tobytes() != traces[1].tobytes():
        step = int(np.flatnonzero((traces[0] != traces[1]).any(axis=1))[0])
        raise UnusableEnvironmentError(
            f"environment {env_id!r} is not deterministic: after reset(seed=1), the same actions led to another "
            f"state at step {step}; it must draw from self.np_random alone"
        )
