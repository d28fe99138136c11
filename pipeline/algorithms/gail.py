"""Generative adversarial imitation from states, with weighted demonstrations: the paper's Eqn (5), (7) and (8).

The weights make the difference between its uses: the jobs that measure transferability weigh the demonstrations of one
cluster equally, naive GAIL weighs all demonstrations equally, and the method weighs them by their transferability.

Letters: N demonstrations, M transitions of all of them, B policy pairs, S observation.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from oodil.pipeline.algorithms.discriminator import (
    Discriminator,
    imitation_reward,
    mean_logit_per_demonstration,
)
from oodil.pipeline.algorithms.divergence import sliced_wasserstein
from oodil.pipeline.algorithms.ends import DemonstratedEnds
from oodil.pipeline.algorithms.learner import Learner
from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.artifacts import below, nested
from oodil.pipeline.config import DiscriminatorConfig, GailConfig
from oodil.pipeline.data import Demonstrations, Episode, TransitionBatch
from oodil.pipeline.errors import DataError
from oodil.pipeline.seeding import derive_key, numpy_rng, torch_seed

DISTANCE_TRANSITIONS = 10_000
"""Drawn from the demonstrations to measure how far an imitator is from them."""


class AdversarialReward:
    """The reward model of GAIL: a discriminator that rewards transitions like those of the weighted demonstrations."""

    def __init__(
        self,
        demonstrations: Demonstrations,
        weights: NDArray[np.float64],
        config: DiscriminatorConfig,
        max_episode_steps: int,
        root_seed: int,
    ) -> None:
        """Prepare to draw pairs in proportion to ``weights`` (N,), one per demonstration (Eqn 7).

        Raises ValueError unless the weights are finite, not negative and not all zero.
        """
        if weights.shape != (len(demonstrations),) or not np.isfinite(weights).all() or (weights < 0).any():
            raise ValueError(f"weights must be {len(demonstrations)} finite numbers >= 0, one per demonstration")
        if weights.sum() <= 0:
            raise ValueError("all weights are zero: there is nothing to imitate")
        self.root_seed = root_seed
        self._starts = demonstrations.transition_starts()
        self._cumulative = np.cumsum(np.repeat(weights, demonstrations.lengths - 1))
        self._state_weights = np.repeat(weights, demonstrations.lengths)
        self._observations = demonstrations.observations
        self.ends = DemonstratedEnds(demonstrations, weights, max_episode_steps, derive_key(root_seed, "ends"))
        seed = torch_seed(derive_key(root_seed, "discriminator", "initial"))
        self.discriminator = Discriminator(demonstrations, weights, config, seed)
        self._policy_inputs: tuple[TransitionBatch, Tensor] | None = None

    def state_standardization(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return (S,) mean and scale of the demonstrations' states under their weights."""
        return standardization(self._observations, self._state_weights)

    @torch.no_grad()
    def rewards(self, batch: TransitionBatch) -> NDArray[np.float32]:
        """Return (T, G) rewards; `Learner` asks for them before the discriminator's step of the same iteration."""
        logits = self.discriminator(self._inputs_of(batch))
        return imitation_reward(logits).numpy().reshape(batch.terminated.shape)

    def goes_on(self, states: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return (E,) whether an end in each of (E, S) states is worth an endless reward: demonstrations end there."""
        return self.ends.include(states)

    def update(self, batch: TransitionBatch, iteration: int, step_scale: float) -> dict[str, float]:
        """Train the discriminator on the batch, a part of it at each step, and on as many demonstration pairs."""
        config = self.discriminator.config
        self.discriminator.optimizer.learning_rate = config.learning_rate * step_scale
        policy_inputs = self._inputs_of(batch)
        rng = numpy_rng(derive_key(self.root_seed, "discriminator", iteration))
        metrics: dict[str, float] = {}
        for chosen in np.array_split(rng.permutation(len(policy_inputs)), config.steps_per_iteration):
            metrics = self.discriminator.update(self.draw(len(chosen), rng), policy_inputs[torch.from_numpy(chosen)])
        return metrics

    def distance(self, episodes: Sequence[Episode]) -> float:
        """Return how far episodes are from the weighted demonstrations, in deviations of what the discriminator sees.

        It is the sliced Wasserstein distance of their transitions, which asks for no reward and for no discriminator.
        Episodes that fail last until the time limit (`DemonstratedEnds.until_limit`).
        """
        rng = numpy_rng(derive_key(self.root_seed, "distance"))
        shown = self.draw(DISTANCE_TRANSITIONS, rng)
        paths = [episode.states for episode in self.ends.until_limit(episodes)]
        states, successors = (np.concatenate([path[part] for path in paths]) for part in (np.s_[:-1], np.s_[1:]))
        return sliced_wasserstein(shown.numpy(), self.discriminator.inputs(states, successors).numpy(), rng)

    def draw(self, count: int, rng: np.random.Generator) -> Tensor:
        """Draw ``count`` demonstration pairs with replacement, in proportion to the weights."""
        points = rng.random(count) * self._cumulative[-1]
        chosen = np.searchsorted(self._cumulative, points, side="right")
        starts = self._starts[np.minimum(chosen, len(self._starts) - 1)]
        return self.discriminator.inputs(self._observations[starts], self._observations[starts + 1])

    def discriminator_arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return the discriminator's parameters by name."""
        return {name: value.numpy() for name, value in self.discriminator.state_dict().items()}

    def mean_logits(self, demonstrations: Demonstrations) -> NDArray[np.float64]:
        """Return (N,) mean logits of the current discriminator over each demonstration."""
        return mean_logit_per_demonstration(self.discriminator, demonstrations)

    def state_dict(self) -> dict[str, Tensor]:
        """Return the parameters of the discriminator and the moments of its optimizer."""
        discriminator = self.discriminator
        return nested("net", discriminator.state_dict()) | nested("optimizer", discriminator.optimizer.state_dict())

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""
        self.discriminator.load_state_dict(below("net", state))
        self.discriminator.optimizer.load_state_dict(below("optimizer", state))

    def _inputs_of(self, batch: TransitionBatch) -> Tensor:
        """Return (B, 2S) inputs of the discriminator; those of the last batch are kept, as an iteration asks twice."""
        if self._policy_inputs is None or self._policy_inputs[0] is not batch:
            shape = len(batch), -1
            states, successors = batch.observations.reshape(shape), batch.next_observations.reshape(shape)
            self._policy_inputs = batch, self.discriminator.inputs(states, successors)
        return self._policy_inputs[1]


def imitator(
    observation_dim: int,
    action_dim: int,
    max_episode_steps: int,
    demonstrations: Demonstrations,
    weights: NDArray[np.float64],
    config: GailConfig,
    seed: int,
) -> Learner[AdversarialReward]:
    """Return an untrained learner whose reward is a discriminator's, for demonstrations with (N,) weights.

    Raises ValueError unless the weights are finite, not negative and not all zero, and DataError when the
    demonstrations' states do not have the imitator's dimensions.
    """
    if demonstrations.observation_dim != observation_dim:
        raise DataError(
            f"demonstrations have states with {demonstrations.observation_dim} dimensions; the imitator's have "
            f"{observation_dim}"
        )
    reward = AdversarialReward(demonstrations, weights, config.discriminator, max_episode_steps, seed)
    return Learner(observation_dim, action_dim, config, reward, seed)
