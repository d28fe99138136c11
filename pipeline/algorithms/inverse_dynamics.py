"""The competing method ID: an inverse model, learned from exploration, says which actions would follow a demonstration.

Cao and Sadigh, *Learning from Imperfect Demonstrations from Agents with Varying Dynamics*, as the paper uses it.
Differs from the released code: states and changes are standardized over the exploration, actions are learned as the
environment takes them, within their range, and no noise is added to those that follow.

Letters: M transitions, N demonstrations, G rows, B batch, S observation, A action.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import linear, smooth_l1_loss

from oodil.pipeline.algorithms.optimizer import Adam
from oodil.pipeline.algorithms.standardization import standardization
from oodil.pipeline.config import InverseDynamicsConfig
from oodil.pipeline.data import Demonstrations, Episode, TransitionBatch
from oodil.pipeline.seeding import Key, derive_key, numpy_rng, torch_seed

Floats = NDArray[np.float64]
Bounds = tuple[NDArray[np.float32], NDArray[np.float32]]
"""The (A,) lowest and highest action."""


@dataclass(frozen=True)
class Exploration:
    """Transitions to learn from, and the episodes that are held out."""

    states: NDArray[np.float32]
    """(M, S)"""
    next_states: NDArray[np.float32]
    """(M, S), before any reset."""
    actions: NDArray[np.float32]
    """(M, A) as the environment took them."""
    held_out: Demonstrations

    @classmethod
    def of(cls, batch: TransitionBatch, bounds: Bounds, share: float, key: Key) -> "Exploration":
        """Cut experience into episodes and hold out some, drawn by ``key``, until they make up ``share`` of it.

        Episodes that the experience breaks off are learned from, and held out only if there is no other.
        """
        num_steps, num_simulators = batch.ended.shape
        ended = batch.ended.copy()
        ended[-1] = True
        ends = np.flatnonzero(ended.T.ravel()) + 1
        begins = np.concatenate(([0], ends[:-1]))
        is_whole = batch.ended.T.ravel()[ends - 1]
        drawn = np.flatnonzero(is_whole) if is_whole.any() else np.arange(len(ends))
        drawn = numpy_rng(key).permutation(drawn)
        before = np.cumsum((ends - begins)[drawn]) - (ends - begins)[drawn]
        chosen = drawn[before < share * num_steps * num_simulators][: len(ends) - 1]

        def by_simulator(values: NDArray[np.float32]) -> NDArray[np.float32]:
            return values.swapaxes(0, 1).reshape(num_steps * num_simulators, -1)

        states, next_states = by_simulator(batch.observations), by_simulator(batch.next_observations)
        episodes = [
            Episode(np.concatenate((states[b : b + 1], next_states[b:e])))
            for b, e in zip(begins[chosen], ends[chosen], strict=True)
        ]
        learned = ~np.isin(np.repeat(np.arange(len(ends)), ends - begins), chosen)
        actions = np.clip(by_simulator(batch.actions), *bounds)
        held_out = Demonstrations.of(episodes, "held out")
        return cls(states[learned], next_states[learned], actions[learned], held_out)


class InverseModel(nn.Module):
    """The action between a state and a wanted next one: [s, s' - s] -> linear, ReLU -> residual blocks -> linear."""

    input_mean: Tensor
    input_scale: Tensor

    def __init__(self, observation_dim: int, action_dim: int, config: InverseDynamicsConfig, key: Key) -> None:
        """Draw an untrained network; ``key`` is also that of its training."""
        super().__init__()
        self._config, self._key = config, key
        width = config.hidden
        self.first = nn.Linear(2 * observation_dim, width)
        self.blocks = nn.ModuleList(nn.Linear(width, width) for _ in range(config.blocks))
        self.last = nn.Linear(width, action_dim)
        self.register_buffer("input_mean", torch.zeros(2 * observation_dim))
        self.register_buffer("input_scale", torch.ones(2 * observation_dim))
        rng = torch.Generator().manual_seed(torch_seed(derive_key(*key, "initial")))
        for layer in (self.first, *self.blocks, self.last):
            assert isinstance(layer, nn.Linear)
            bound = layer.in_features**-0.5
            nn.init.uniform_(layer.weight, -bound, bound, generator=rng)
            nn.init.uniform_(layer.bias, -bound, bound, generator=rng)
        self._adam = Adam(list(self.parameters()), config.learning_rate)

    def forward(self, inputs: Tensor, product: Callable[[Tensor, Tensor, Tensor], Tensor] = linear) -> Tensor:
        """Return (B, A) actions for (B, 2S) states and changes; ``product`` computes a layer from weight and bias."""

        def layer(module: nn.Module, values: Tensor) -> Tensor:
            assert isinstance(module, nn.Linear)
            return product(values, module.weight, module.bias)

        hidden = torch.relu(layer(self.first, (inputs - self.input_mean) * self.input_scale))
        for block in self.blocks:
            # h <- relu(h + relu(W h))
            hidden = torch.relu(hidden + torch.relu(layer(block, hidden)))
        return layer(self.last, hidden)

    def learn(self, exploration: Exploration, number: int) -> float:
        """Pass over the transitions once, for the ``number``-th time from 0, and return the mean smooth L1 loss."""
        inputs = _inputs(exploration.states, exploration.next_states)
        if number == 0:
            for buffer, values in zip(
                (self.input_mean, self.input_scale), standardization(inputs.numpy()), strict=True
            ):
                buffer.copy_(torch.from_numpy(values))
        actions = torch.from_numpy(exploration.actions)
        order = torch.from_numpy(numpy_rng(derive_key(*self._key, "pass", number)).permutation(len(inputs)))
        total = 0.0
        for rows in order.split(self._config.batch_size):
            loss = smooth_l1_loss(self(inputs[rows]), actions[rows])
            self._adam.step(loss)
            total += float(loss.detach()) * len(rows)
        if not np.isfinite(total):
            raise FloatingPointError(f"the inverse model diverged in pass {number + 1}: its loss is {total}")
        return total / len(inputs)

    @torch.no_grad()
    def act(self, states: Floats, wanted: Floats) -> NDArray[np.float32]:
        """Return (G, A) actions that are to lead from (G, S) states to the wanted ones, not yet within their range."""
        return np.asarray(self(_inputs(states, wanted), _row_by_row).numpy())

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """Return what `act` needs; `load` is the inverse."""
        return {name: value.numpy() for name, value in self.state_dict().items()}

    def load(self, arrays: dict[str, NDArray[np.float32]]) -> None:
        """Take over a trained model."""
        self.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})

    def moments(self) -> dict[str, NDArray[np.float32]]:
        """Return the optimizer's state; with `arrays` it is all that a training depends on."""
        return {name: value.numpy() for name, value in self._adam.state_dict().items()}

    def load_moments(self, arrays: dict[str, NDArray[np.float32]]) -> None:
        """Continue from `moments`."""
        self._adam.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})


def error_bounds(errors: Floats, held_out: Floats) -> tuple[float, float]:
    """Return the errors up to which a demonstration scores 1, and from which on 0.

    They are the least and the largest error of (M,) held-out episodes, which the environment itself has made; if all
    of the (N,) demonstrations are above that, the largest of theirs.
    """
    largest = held_out.max()
    return float(held_out.min()), float(errors.max() if errors.min() > largest else largest)


def _inputs(states: NDArray[np.floating], next_states: NDArray[np.floating]) -> Tensor:
    """Return (B, 2S) states and the changes to the next ones."""
    return torch.from_numpy(np.concatenate((states, next_states - states), axis=1).astype(np.float32))


def _row_by_row(values: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return what `linear` does, rounded in the same way whichever rows are beside a row."""
    rows = np.einsum("bi,io->bo", values.numpy(), np.ascontiguousarray(weight.numpy().T))
    return torch.from_numpy(rows + bias.numpy())
