"""The on-policy learner of experts and imitators: a policy optimizer, a value function and a reward model.

An iteration is: rewards of the current reward model -> advantages -> policy step -> value fit -> step of the reward
model. Experts learn from the environment's reward, imitators from a discriminator; nothing else differs.

Letters: T steps, G simulators (all env groups side by side), B = T * G, S observation, A action.
"""

from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from oodil.pipeline.algorithms.advantages import generalized_advantages, standardized
from oodil.pipeline.algorithms.networks import PolicyNetwork
from oodil.pipeline.algorithms.policy_optimizer import policy_optimizer
from oodil.pipeline.algorithms.standardization import mean_and_scale
from oodil.pipeline.algorithms.value import ValueFunction
from oodil.pipeline.artifacts import below, nested
from oodil.pipeline.config import TrainingConfig
from oodil.pipeline.data import TransitionBatch
from oodil.pipeline.policy import GaussianPolicy
from oodil.pipeline.seeding import derive_key, torch_seed


class RewardModel(Protocol):
    """Where an iteration's rewards come from."""

    def state_standardization(self) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Return (S,) mean and scale to normalize states by; None lets the learner estimate them."""

    def rewards(self, batch: TransitionBatch) -> NDArray[np.float32]:
        """Return (T, G) rewards."""

    def goes_on(self, states: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return (E,) whether an episode that ended in each of (E, S) states has its last reward for ever.

        A positive reward pays for going on: right where demonstrations go on, wrong at a goal where they end.
        """

    def update(self, batch: TransitionBatch, iteration: int, step_scale: float) -> dict[str, float]:
        """Take the iteration's training step and return metrics; ``step_scale`` multiplies the step size."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything needed to continue."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""


class EnvReward:
    """The environment's own reward, for training experts only."""

    def state_standardization(self) -> None:
        """Return None: the states are not known before training."""
        return None

    def rewards(self, batch: TransitionBatch) -> NDArray[np.float32]:
        """Return the (T, G) rewards of the environment."""
        return batch.env_rewards.astype(np.float32)

    def goes_on(self, states: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Return that none does: the environment says itself what an end is worth."""
        return np.zeros(len(states), np.bool_)

    def update(self, batch: TransitionBatch, iteration: int, step_scale: float) -> dict[str, float]:
        """Return no metrics: an environment's reward does not learn."""
        return {}

    def state_dict(self) -> dict[str, Tensor]:
        """Return nothing: an environment's reward has no state."""
        return {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Accept the empty state."""


Reward = TypeVar("Reward", bound=RewardModel)


class Learner(Generic[Reward]):
    """A policy, a value function and a reward model, updated together once per iteration."""

    def __init__(
        self, observation_dim: int, action_dim: int, config: TrainingConfig, reward_model: Reward, root_seed: int
    ) -> None:
        self.config = config
        self.reward_model = reward_model
        self.root_seed = root_seed
        self._reward_scale = 1 - config.discount if config.scale_rewards else 1.0
        rng = torch.Generator().manual_seed(torch_seed(derive_key(root_seed, "learner", "initial")))
        self.policy = PolicyNetwork(observation_dim, action_dim, config.policy_hidden, rng)
        with torch.no_grad():
            self.policy.log_std.fill_(config.initial_log_std)
        self.value = ValueFunction(observation_dim, config.value, rng)
        self.policy_optimizer = policy_optimizer(self.policy, config.policy_optimizer)
        known = reward_model.state_standardization()
        self._tracks_moments = config.normalize_observations and known is None
        if config.normalize_observations and known is not None:
            self.policy.standardize_by(*known)
        self._moments = torch.zeros(1 + 2 * observation_dim, dtype=torch.float64)

    def behavior_policy(self) -> GaussianPolicy:
        """Return a copy of the current policy for rollout workers."""
        return self.policy.export()

    def value_arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return a copy of the value function's parameters by name."""
        return {name: value.numpy().copy() for name, value in self.value.state_dict().items()}

    def continue_from(self, policy: GaussianPolicy, value: dict[str, NDArray[np.float32]], std: float) -> None:
        """Begin with a trained policy, its noise set to ``std``, and with the value function trained with it."""
        self.config = self.config.model_copy(update={"initial_log_std": float(np.log(std))})
        self.policy.load_mean(policy)
        with torch.no_grad():
            self.policy.log_std.fill_(self.config.initial_log_std)
        self.value.load_state_dict({name: torch.from_numpy(each) for name, each in value.items()})

    def update(self, batch: TransitionBatch, iteration: int) -> dict[str, float]:
        """Learn from one iteration's batch.

        Returns metrics, by names that do not change:
            reward: mean of what the reward model gave.
            policy_lag: updates since the policy that collected the batch, 0 or 1.
            kl: divergence from the policy before the update, in nats per state.
            entropy: of the new policy, in nats.
            value_loss: mean squared error in the last minibatch.
            improvement, step_fraction: of TRPO alone, see `Trpo.update`.
            discriminator_loss, discriminator_demonstration_loss, discriminator_policy_loss,
            discriminator_squared_gradient, demonstration_accuracy, policy_accuracy: of imitators alone, see
            `Discriminator.update`.
        """
        config = self.config
        step_scale = 1 - iteration / config.num_iterations if config.anneal else 1.0
        rng = torch.Generator().manual_seed(torch_seed(derive_key(self.root_seed, "learner", iteration)))
        rewards = self.reward_model.rewards(batch)
        metrics = {"reward": float(rewards.mean()), "policy_lag": float(iteration - batch.policy_version)}
        # Scaled by 1 - discount, values are averages of rewards, and so of order one for every horizon.
        rewards *= np.float32(self._reward_scale)
        for_ever = self.reward_model.goes_on(batch.next_observations[batch.terminated])
        rewards[batch.terminated] *= np.where(for_ever, np.float32(1 / (1 - config.discount)), np.float32(1))
        observations = torch.from_numpy(batch.observations).flatten(0, 1)
        inputs = self.policy.normalize(observations)
        values, next_values = self._values(inputs, batch)
        advantages = generalized_advantages(
            rewards, values, next_values, batch.terminated, batch.truncated, config.discount, config.gae_lambda
        )
        metrics |= self.policy_optimizer.update(
            observations,
            torch.from_numpy(batch.actions).flatten(0, 1),
            torch.from_numpy(batch.log_probs).flatten(),
            torch.from_numpy(standardized(advantages)).flatten(),
            rng,
            step_scale,
        )
        self._shrink_noise(iteration)
        metrics |= self.value.fit(inputs, torch.from_numpy(advantages + values).flatten(), rng)
        metrics |= self.reward_model.update(batch, iteration, step_scale)
        if self._tracks_moments:
            # Last, so that without lag the policy that is improved is the one that collected.
            self._track(observations)
        return metrics

    @torch.no_grad()
    def _shrink_noise(self, iteration: int) -> None:
        """Lower the bounds between which the policy's deviation lies in the second half, until both are its last value.

        There is a floor from the beginning: a policy that has lost its noise early explores no more.
        """
        config = self.config
        if config.final_std is not None:
            done = max(0.0, 2 * (iteration + 1) / config.num_iterations - 1)
            last, highest = float(np.log(config.final_std)), config.initial_log_std
            lowest = min(float(np.log(config.least_std)), highest)
            self.policy.log_std.clamp_((1 - done) * lowest + done * last, (1 - done) * highest + done * last)

    @torch.no_grad()
    def _values(self, inputs: Tensor, batch: TransitionBatch) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return (T, G) values of the states, given normalized as ``inputs`` (B, S), and of their successors."""
        # The successor's value is in the next row, except at episode ends and in the last row: only those cost a pass.
        values = self.value(inputs).numpy().reshape(batch.terminated.shape)
        next_values = np.empty_like(values)
        next_values[:-1] = values[1:]
        apart = batch.ended
        apart[-1] = True
        successors = self.policy.normalize(torch.from_numpy(batch.next_observations[apart]))
        next_values[apart] = self.value(successors).numpy()
        return values, next_values

    @torch.no_grad()
    def _track(self, observations: Tensor) -> None:
        """Set the input normalizer to the mean and standard deviation of all observations so far."""
        wide = observations.double()
        self._moments += torch.cat((torch.tensor([float(len(wide))]), wide.sum(0), wide.square().sum(0)))
        count, (total, squares) = self._moments[0], self._moments[1:].view(2, -1).numpy()
        mean = total / float(count)
        self.policy.standardize_by(
            *mean_and_scale(mean, np.sqrt(np.maximum(0, squares / float(count) - np.square(mean))))
        )

    def state_dict(self) -> dict[str, Tensor]:
        """Return everything that later iterations depend on, as named tensors."""
        state = {"moments": self._moments}
        for name, part in self._parts().items():
            state |= nested(name, part.state_dict())
        return state

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Continue from `state_dict`."""
        self._moments.copy_(state["moments"])
        for name, part in self._parts().items():
            part.load_state_dict(below(name, state))

    def _parts(self) -> dict[str, Any]:
        """Return everything with a ``state_dict``, by its name in the learner's own."""
        return {
            "policy": self.policy,
            "value": self.value,
            "policy_optimizer": self.policy_optimizer,
            "value_optimizer": self.value.optimizer,
            "reward_model": self.reward_model,
        }
