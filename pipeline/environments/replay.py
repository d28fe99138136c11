"""Any deterministic Gymnasium environment, its inner state unknown: a snapshot is a start and the actions since.

Restoring plays an episode again from its start, and sees that it is the same one. That is as slow as it sounds, so a
batch that stands where it is asked to go does nothing; workers keep one batch per env group, and a group tends to stay
with its worker.

Letters: G simulators, S observation, A action.
"""

import time

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Snapshot
from oodil.pipeline.environments.batch import StepOutcome
from oodil.pipeline.environments.foreign import ForeignEnvironment
from oodil.pipeline.errors import UnusableEnvironmentError

_TRIAL_SPREADS = (1.0, 0.3, 0.0)
"""Of the actions of each episode of a trial; robots fall soon under large ones."""
_TRIAL_STEPS, _TRIAL_S = 10_000, 4.0
"""What is played before it is played again, at most."""
_LONGEST_WITHOUT_END = 100_000
"""Time limit in steps of an environment of which no trial came to an end."""


class ReplayBatch:
    """G Gymnasium environments side by side; the caller decides when an ended one is reset.

    An environment that has ended stays where it is, whatever its action, until it is reset. Actions are in units of the
    action space. Of the episodes that are over, the 1st, 2nd, 4th, 8th and so on are played once more: whatever
    does not come out the same raises UnusableEnvironmentError.
    """

    def __init__(self, environments: list[ForeignEnvironment], max_episode_steps: int) -> None:
        """Take over environments of one kind."""
        self._environments = environments
        self.num_simulators = len(environments)
        self.max_episode_steps = max_episode_steps
        self.observation_dim = environments[0].observation_dim
        self.action_dim = environments[0].action_dim
        self.steps_per_second = environments[0].steps_per_second
        self._episodes = 0

    def observations(self) -> NDArray[np.float64]:
        """Return (G, S) observations of the present states, flattened."""
        return np.stack([each.observation for each in self._environments])

    def reset(self, simulator: int, seed: int) -> None:
        """Start a new episode in one environment with a seed of at most 2**53."""
        self._look_again(simulator)
        self._environments[simulator].reset(seed)

    def place(self, simulator: int, observation: NDArray[np.floating]) -> None:
        """Start a new episode in one environment, put where (S,) is observed by its own method ``place``.

        Raises UnusableEnvironmentError if it has none.
        """
        self._look_again(simulator)
        self._environments[simulator].place(observation.astype(np.float64))

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) that all do: an environment with a method ``place`` says so by having it."""
        return np.ones(len(observations), np.bool_)

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions, clipped to the action space, in every environment that has not ended."""
        rewards = np.zeros(self.num_simulators)
        for i in np.flatnonzero(~self._ended()).tolist():
            rewards[i] = self._environments[i].step(actions[i].astype(np.float32))
        terminated = np.array([each.terminated for each in self._environments])
        return StepOutcome(rewards, terminated, self._truncated())

    def elapsed_steps(self) -> NDArray[np.int64]:
        """Return (G,) steps since the last reset of each environment."""
        return np.array([each.elapsed for each in self._environments], np.int64)

    def episode_returns(self) -> NDArray[np.float64]:
        """Return (G,) sums of the environment's own reward since the last reset; for evaluation only."""
        return np.array([each.env_return for each in self._environments])

    def snapshot(self) -> Snapshot:
        """Save all environments; `restore` continues from here to the same bits."""
        histories = [each.history() for each in self._environments]
        states = np.zeros((self.num_simulators, max(map(len, histories))))
        for row, history in zip(states, histories, strict=True):
            row[: len(history)] = history
        return Snapshot(states, self.elapsed_steps(), self.episode_returns())

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of a batch of the same size, playing again what is not there yet.

        Raises UnusableEnvironmentError if an episode differs from what was seen.
        """
        if len(snapshot.states) != self.num_simulators:
            raise ValueError(f"snapshot holds {len(snapshot.states)} histories; this batch has {self.num_simulators}")
        rows = zip(self._environments, snapshot.states, snapshot.elapsed_steps.tolist(), strict=True)
        for environment, history, elapsed in rows:
            if not environment.stands_at(history, elapsed):
                environment.replay(history, elapsed)

    def render(self, simulator: int) -> NDArray[np.uint8]:
        """Return what an environment draws (height, width, 3). Raises UnusableEnvironmentError if it cannot."""
        return self._environments[simulator].render()

    def close(self) -> None:
        """Close the environments."""
        for environment in self._environments:
            environment.close()

    def _truncated(self) -> NDArray[np.bool_]:
        return np.array([each.truncated or each.elapsed >= self.max_episode_steps for each in self._environments])

    def _ended(self) -> NDArray[np.bool_]:
        return np.array([each.terminated for each in self._environments]) | self._truncated()

    def _look_again(self, simulator: int) -> None:
        """Play the episode that is over once more, ever more seldom."""
        environment = self._environments[simulator]
        if environment.elapsed:
            self._episodes += 1
            if not self._episodes & (self._episodes - 1):
                environment.replay(environment.history(), environment.elapsed)


def refuse_randomness(one: ForeignEnvironment, other: ForeignEnvironment, max_episode_steps: int) -> None:
    """Raise UnusableEnvironmentError if the same start and actions can lead elsewhere, in either of two environments.

    Whole episodes are played, then again in the same environment after others, and in the other one. Raises it, too, if
    nothing ends an episode but a limit so large that it is none.
    """
    rng, began, left = np.random.default_rng(0), time.monotonic(), _TRIAL_STEPS
    episodes, has_end = [], False
    for number, spread in enumerate(_TRIAL_SPREADS):
        one.reset(seed=number + 1)
        while not (one.terminated or one.truncated) and one.elapsed < min(max_episode_steps, left):
            one.step(spread * rng.standard_normal(one.action_dim, dtype=np.float32))
            if time.monotonic() - began > _TRIAL_S * (number + 1) / len(_TRIAL_SPREADS):
                break
        has_end = has_end or one.terminated or one.truncated
        left -= one.elapsed
        episodes.append((one.history(), one.elapsed))
    for environment, again in ((one, episodes[::-1]), (other, episodes)):
        for history, elapsed in again:
            environment.replay(history, elapsed)
    if not has_end and max_episode_steps > _LONGEST_WITHOUT_END:
        raise UnusableEnvironmentError(
            f"environment {one.env_id!r}: nothing ended an episode of {max(steps for _, steps in episodes)} steps, and "
            f"its time limit is {max_episode_steps} steps, more than {_LONGEST_WITHOUT_END}; set a shorter one, as in "
            "dynamics: {max_episode_steps: 1000}"
        )
