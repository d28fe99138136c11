"""The feasibility MDP: simulators whose task is to track demonstrations, state by state.

An episode begins where a demonstration does, is rewarded for staying close to its states, and ends with it. What is
observed is the simulator's state and the demonstration's first, which says what to track. Whether the environment
itself would have ended plays no part; one that can only be stepped through Gymnasium stays where it ended.

Letters: G simulators, N demonstrations, S observation, A action.
"""

import numpy as np
from numpy.typing import NDArray

from oodil.pipeline.data import Demonstrations, Snapshot
from oodil.pipeline.environments.batch import Simulators, StepOutcome
from oodil.pipeline.errors import UnusableEnvironmentError
from oodil.pipeline.policy import Controller

Floats = NDArray[np.float64]


class TrackingSimulators:
    """G simulators that track demonstrations; a `Simulators` whose return is minus the discounted distance so far."""

    def __init__(
        self, simulators: Simulators, demonstrations: Demonstrations, discount: float, scale: NDArray[np.floating]
    ) -> None:
        """Take over simulators that can be placed.

        Args:
            simulators: of the imitator's environment.
            demonstrations: what a fresh episode is drawn from, evenly.
            discount: by which the distance after each further step counts less.
            scale: (S,) that differences of states are multiplied by.
        """
        self._simulators = simulators
        self._states = demonstrations.observations.astype(np.float64)
        self._first = demonstrations.offsets[:-1]
        self._steps = demonstrations.lengths - 1
        self._discount = discount
        self._scale = scale.astype(np.float64)
        self.num_simulators = simulators.num_simulators
        self.max_episode_steps = int(self._steps.max())
        self.observation_dim = 2 * simulators.observation_dim
        self.action_dim = simulators.action_dim
        self._tracked = np.zeros(self.num_simulators, np.int64)
        self._elapsed = np.zeros(self.num_simulators, np.int64)
        self._returns = np.zeros(self.num_simulators)

    @property
    def num_demonstrations(self) -> int:
        """N."""
        return len(self._first)

    def observations(self) -> Floats:
        """Return (G, 2 S): present states, and the first states of the demonstrations that are tracked."""
        return np.concatenate((self._simulators.observations(), self._states[self._first[self._tracked]]), axis=1)

    def reset(self, simulator: int, seed: int) -> None:
        """Start a new episode in one simulator, where a demonstration begins that the seed draws."""
        self.track(simulator, int(np.random.default_rng(seed).integers(self.num_demonstrations)))

    def track(self, simulator: int, demonstration: int) -> None:
        """Start a new episode in one simulator, where this demonstration begins."""
        self._simulators.place(simulator, self._states[self._first[demonstration]])
        self._tracked[simulator] = demonstration
        self._elapsed[simulator] = 0
        self._returns[simulator] = 0.0

    def place(self, simulator: int, observation: NDArray[np.floating]) -> None:
        """Raise UnusableEnvironmentError: an episode begins where a demonstration does, see `track`."""
        raise UnusableEnvironmentError("simulators that track demonstrations begin where one of them does")

    def tells_state(self, observations: NDArray[np.floating]) -> NDArray[np.bool_]:
        """Return (N,) that none does: how much of the demonstration is over is not observed."""
        return np.zeros(len(observations), np.bool_)

    def step(self, actions: NDArray[np.floating]) -> StepOutcome:
        """Apply (G, A) actions for one control step; nothing is rewarded after a demonstration's last state."""
        self._simulators.step(actions)
        steps = self._steps[self._tracked]
        wanted = self._states[self._first[self._tracked] + np.minimum(self._elapsed + 1, steps)]
        missed = np.linalg.norm((self._simulators.observations() - wanted) * self._scale, axis=1)
        rewards = np.where(self._elapsed < steps, -(self._discount**self._elapsed) * missed, 0.0)
        self._elapsed += 1
        self._returns += rewards
        return StepOutcome(rewards, self._elapsed >= steps, np.zeros(self.num_simulators, np.bool_))

    def elapsed_steps(self) -> NDArray[np.int64]:
        """Return (G,) steps since the last reset of each simulator."""
        return self._elapsed.copy()

    def episode_returns(self) -> Floats:
        """Return (G,) minus the discounted sums of distances since the last reset."""
        return self._returns.copy()

    def snapshot(self) -> Snapshot:
        """Save all simulators; `restore` continues from here to the same bits."""
        inner = self._simulators.snapshot()
        rest = np.stack((inner.elapsed_steps, inner.episode_returns, self._tracked), axis=1)
        return Snapshot(np.concatenate((inner.states, rest), axis=1), self._elapsed.copy(), self._returns.copy())

    def restore(self, snapshot: Snapshot) -> None:
        """Continue from a snapshot of a batch of the same size, task and demonstrations."""
        elapsed, returns, tracked = snapshot.states[:, -3:].T
        states = np.ascontiguousarray(snapshot.states[:, :-3])
        self._simulators.restore(Snapshot(states, elapsed.astype(np.int64), returns.copy()))
        self._tracked[:] = tracked
        self._elapsed[:] = snapshot.elapsed_steps
        self._returns[:] = snapshot.episode_returns


def distances(simulators: TrackingSimulators, controller: Controller) -> Floats:
    """Return (N,) sums of discount^j times the distance after step j + 1, j from 0, of mean actions that track each."""
    size, count = simulators.num_simulators, simulators.num_demonstrations
    found = np.empty(count)
    for begin in range(0, count, size):
        turn = np.minimum(np.arange(begin, begin + size), count - 1)
        for g, n in enumerate(turn.tolist()):
            simulators.track(g, n)
        ended = np.zeros(size, np.bool_)
        while not ended.all():
            ended = simulators.step(controller.mean(simulators.observations())).terminated
        found[turn] = -simulators.episode_returns()
    return found
